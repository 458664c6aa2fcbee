"""The camera, emulated: over a local socket, or as a GigE Vision device."""
