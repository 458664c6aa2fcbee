"""Reading pictures that the project drew."""

import cv2
import numpy as np


def pixels(png: bytes) -> np.ndarray:
    """Decode to RGB, failing on anything but a whole PNG."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1]
