"""Patterns and the projector that shows them.

Knows: the pattern sequence as data and the frames that follow from it, its files and messages, and
the DMD drivers at the byte level. Must not know: cameras, rigs, decoding.
"""
