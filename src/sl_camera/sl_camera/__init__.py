"""Cameras, stages, and which trigger, image and pose belong together.

Knows: camera and stage drivers and the matching by count and time. Must not know: what the images
mean, rigs, the bench. Imports data types of `sl_projector` only.
"""
