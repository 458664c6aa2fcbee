"""The hole plate, and finding its holes in an image."""
