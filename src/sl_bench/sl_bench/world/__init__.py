"""The simulated world: rig, part, light path and sensor give the camera's image.

Each imperfection is configured in one place and is off, or at the reference rig's value, unless
asked for: the part's form in `surfaces`, its reflection in `optics.Finish`, blur, light and sensor
in `optics.Optics`, stage and mounting in `mounting.Mounting`, lenses in the rig, which
`raycast.device_data` packs for the kernels. `truth` gives the right values for any configuration.
"""
