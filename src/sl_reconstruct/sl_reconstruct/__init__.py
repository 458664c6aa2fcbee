"""From a stack of images to a measured surface.

Knows: the rig model (Eqs. 1-4 of Tsai & Hung 2005), decoding, sub-pixel edges and centres,
triangulation, clouds and their files, measurement of surfaces. Must not know: devices, how the
images were taken, the bench. Imports data types of `sl_projector` only.
"""
