"""The projector's controllers, emulated at the byte level."""
