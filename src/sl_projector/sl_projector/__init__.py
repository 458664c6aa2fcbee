"""Patterns and the projector that shows them.

Knows: the pattern sequence as data and the frames that follow from it, the DMD driver at the byte
level, sequence files, the exception tree, and what every node shares. Must not know: cameras,
rigs, decoding, or any other ``sl_*`` package.
"""

from sl_projector import kernel_cache

kernel_cache.choose()
