"""What all packages share and none owns. Imports no other ``sl_*`` package.

Knows: the exception tree, documents, the clock, device links, where compiled kernels are kept, what
every node shares, and the names of topics. Must not know: patterns, devices, rigs, the bench.
"""
