"""The image memory of the emulated DLPC900: one part for each controller of the DMD."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc900_images import decode_image
from sl_bench.dlpc.dlpc_emulator import Error, Refusal, invalid
from sl_projector.dlpc.dmd import DmdModel

MAX_FLY_IMAGES = 18


@dataclass
class _Upload:
    """An image on its way into the controller."""

    image: int
    total: int
    data: bytearray = field(default_factory=bytearray)


@dataclass
class _Controller:
    """One controller's images, as bit planes of its part of the columns."""

    images: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    upload: _Upload | None = None


class ImageMemory:
    """Images loaded on the fly.

    Parameters
    ----------
    model : DmdModel
        With two controllers each holds one half of the columns, the primary the left one.
    strict : bool
        As `decode_image`'s.
    """

    def __init__(self, model: DmdModel, *, strict: bool = False) -> None:
        self._strict = strict
        halves = 2 if model.dual else 1
        self._width, self._height = model.columns // halves, model.rows
        self._controllers = [_Controller() for _ in range(halves)]

    def clear(self) -> None:
        """Forget the images."""
        for controller in self._controllers:
            controller.images.clear()

    def holds(self, image: int) -> bool:
        """Tell whether an image is complete in all controllers."""
        return all(image in controller.images for controller in self._controllers)

    def plane(self, image: int, plane: int) -> NDArray[np.bool_]:
        """Return a bit plane, (rows, columns), True where the mirror is on.

        Parameters
        ----------
        image : int
            A complete image; see `holds`.
        plane : int
            0 to 23.
        """
        parts = [c.images[image][plane // 8] for c in self._controllers]
        mirrors: NDArray[np.bool_] = (np.hstack(parts) & np.uint8(1 << plane % 8)) != 0
        return mirrors

    def begin(self, controller: int, data: bytes) -> None:
        """Begin to load an image (0x1A2A, 0x1A2C).

        Parameters
        ----------
        controller : {0, 1}
            Primary, secondary.
        data : bytes
            Image (u16), its size in bytes (u32).
        """
        target = self._controller(controller)
        image, total = struct.unpack_from("<HI", data)
        if image & 0x1F >= MAX_FLY_IMAGES:
            raise invalid(f"image {image} on the fly")
        target.images.pop(image & 0x1F, None)
        target.upload = _Upload(image & 0x1F, total)

    def take(self, controller: int, data: bytes) -> None:
        """Take the next part of the image (0x1A2B, 0x1A2D); the last one decodes it.

        Parameters
        ----------
        controller : {0, 1}
            Primary, secondary.
        data : bytes
            Number of bytes (u16), the bytes.
        """
        target = self._controller(controller)
        upload = target.upload
        count = struct.unpack_from("<H", data)[0] & 0x3FF
        if not count:  # some hosts (Pycrafter6500) end with an empty part
            return
        if upload is None:
            raise Refusal(Error.NOT_PRESENT, "image data without its start")
        if len(data) - 2 < count:
            raise invalid(f"chunk of {len(data) - 2} bytes; it says {count}")
        upload.data += data[2 : 2 + count]
        if len(upload.data) >= upload.total:
            target.upload = None
            target.images[upload.image] = self._decoded(upload)

    def _controller(self, number: int) -> _Controller:
        if number >= len(self._controllers):
            raise invalid("there is no secondary controller")
        return self._controllers[number]

    def _decoded(self, upload: _Upload) -> NDArray[np.uint8]:
        if len(upload.data) > upload.total:
            raise invalid(f"{len(upload.data)} bytes of image; announced {upload.total}")
        return decode_image(bytes(upload.data), self._width, self._height, strict=self._strict)
