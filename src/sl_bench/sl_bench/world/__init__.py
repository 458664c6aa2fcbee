"""The simulated world: rig, part, light path and sensor give the camera's image."""
