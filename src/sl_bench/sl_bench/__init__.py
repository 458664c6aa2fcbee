"""A simulated bench: one world, and emulators of the devices in it.

Knows: rig and surface as a world that says how much light each camera pixel gets, the photon
chain, and the devices at their byte seams. Must not know: decoder and triangulation, since an
error shared with them would cancel. Emulators share the world, not each other.
"""
