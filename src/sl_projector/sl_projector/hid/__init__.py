"""64-byte HID reports to and from a projector: real USB, or a socket in its place."""
