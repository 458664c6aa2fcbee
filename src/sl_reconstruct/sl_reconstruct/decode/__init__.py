"""From the images of one stack to sub-pixel boundaries along every camera row."""
