"""What a camera is: frames, pixel formats, frame numbers, its clock and software triggers."""
