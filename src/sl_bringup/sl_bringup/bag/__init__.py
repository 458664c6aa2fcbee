"""Recordings: reading, writing, and what damaged ones still hold."""
