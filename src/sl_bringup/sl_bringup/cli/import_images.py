"""``slrig import``: a folder of images becomes a recording, as if the graph had taken them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_bringup.bag.bag_writer import BagWriter, Storage, new_bag
from sl_bringup.bag.bags import natural_key
from sl_bringup.cli.patterns import dmd_size
from sl_bringup.graph.console import ProgressLine, say
from sl_common.errors import StackError
from sl_projector.sequence.sequence_file import SequenceFile, find_sequence
from sl_reconstruct.model.calibration_file import Calibration, load_calibration

SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm", ".pnm", ".webp")

#: Images carry no times. A fixed start keeps the same import the same recording, bit for bit.
START_NS = 1_000_000_000_000_000_000
FRAME_NS = 33_333_333
EXPOSURE_S = 0.02
#: How long after the start of its exposure a frame is said to have come.
READOUT_NS = 25_000_000
PAUSE_NS = 1_000_000_000


@dataclass
class Notes:
    """What the import did to the images, for the user to know."""

    lines: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        """Keep a line once."""
        if line not in self.lines:
            self.lines.append(line)


def scan_folders(folder: Path) -> list[Path]:
    """Folders that hold one scan each: the folder itself, or its sub-folders with images.

    Raises
    ------
    StackError
        When there are no images, or images beside sub-folders with images.
    """
    if not folder.is_dir():
        raise StackError(f"{folder} is not a folder; expected a folder of images")
    subfolders = sorted((p for p in folder.iterdir() if p.is_dir()), key=natural_key)
    with_images = [p for p in subfolders if image_files(p)]
    own = image_files(folder)
    if own and with_images:
        raise StackError(
            f"{folder} has {len(own)} images and sub-folders with images "
            f"({', '.join(p.name for p in with_images)}); expected one or the other"
        )
    if not own and not with_images:
        raise StackError(f"{folder} has no images; expected files named {', '.join(SUFFIXES)}")
    return with_images or [folder]


def image_files(folder: Path) -> list[Path]:
    """Image files of a folder in natural order (``9.png`` before ``10.png``)."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
    return sorted((p for p in found if not p.name.startswith(".")), key=natural_key)


def files_of_scan(folder: Path, described: SequenceFile) -> list[Path]:
    """One image file per pattern: those the sequence file names, else all in natural order.

    Parameters
    ----------
    folder : Path
        Folder of the images.
    described : SequenceFile
        The sequence, with file names where it has them.

    Raises
    ------
    StackError
        When the count is wrong or a named file is missing.
    """
    found, names = image_files(folder), described.files
    present = {p.name: p for p in found}
    if any(name in present for name in names if name):
        missing = [str(name) for name in names if name not in present]
        if missing:
            raise StackError(
                f"{folder} lacks {len(missing)} of the {len(names)} images that the sequence "
                f"names, {missing[0]} the first"
            )
        return [present[name] for name in names if name]
    if len(found) != len(described.sequence):
        raise StackError(
            f"{folder} has {len(found)} images; expected {len(described.sequence)}, the patterns "
            f"of the sequence {described.sequence.name!r}"
        )
    return found


def read_image(path: Path, notes: Notes) -> NDArray[Any]:
    """Read an image as (H, W) uint8 or uint16; colour becomes grey, and a note says so.

    Parameters
    ----------
    path : Path
        PNG, TIFF, BMP or what else OpenCV reads.
    notes : Notes
        Collects what the user should know.

    Raises
    ------
    StackError
        When it cannot be read or has another depth.
    """
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise StackError(f"{path} cannot be read as an image ({data.size} bytes)")
    if image.dtype not in (np.uint8, np.uint16):
        raise StackError(f"{path} has {image.dtype} pixels; expected 8 or 16 bit")
    return image if image.ndim == 2 else _grey(image, notes)


def _grey(image: NDArray[Any], notes: Notes) -> NDArray[Any]:
    colour = np.ascontiguousarray(image[..., :3]) if image.shape[2] >= 3 else image[..., :1]
    if (colour == colour[..., :1]).all():
        notes.add("the images have equal colour channels; one of them was taken")
        return np.ascontiguousarray(colour[..., 0])
    notes.add(
        "the images are in colour and were made grey (0.299 R + 0.587 G + 0.114 B); a sensor "
        "with a colour mosaic blurs the edges that are measured"
    )
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


def import_folder(
    folder: Path,
    described: SequenceFile,
    output: Path,
    storage: Storage = "mcap",
    calibration: tuple[Path, Callable[[tuple[int, int]], Calibration]] | None = None,
    step: Callable[[], object] = lambda: None,
) -> Notes:
    """Write a recording of all scans in a folder.

    Parameters
    ----------
    folder : Path
        Images of one scan, or a sub-folder for each.
    described : SequenceFile
        What was projected.
    output : Path
        rosbag2 directory to be made.
    storage : {"mcap", "sqlite3"}
        Storage plug-in.
    calibration : tuple, optional
        A calibration file, and what reads it when the image size (w, h) is known.
    step : callable
        Called after each image.

    Raises
    ------
    StackError
        When the images do not fit the sequence or each other.
    BagError
        When the recording cannot be written.
    """
    notes = Notes()
    scans = [files_of_scan(scan, described) for scan in scan_folders(folder)]
    custom = {"imported_from": folder.resolve().name, "sequence": described.sequence.name}
    with new_bag(output, storage, notes=custom) as bag:
        first = read_image(scans[0][0], notes)
        if calibration is not None:
            path, load = calibration
            bag.calibration(load((first.shape[1], first.shape[0])), path.name, START_NS)
        start_ns = START_NS + PAUSE_NS
        for number, files in enumerate(scans, start=1):
            _write_scan(bag, described, number, files, first, start_ns, notes, step)
            start_ns += len(files) * FRAME_NS + PAUSE_NS
    return notes


def _write_scan(
    bag: BagWriter,
    described: SequenceFile,
    scan_id: int,
    files: Sequence[Path],
    first: NDArray[Any],
    start_ns: int,
    notes: Notes,
    step: Callable[[], object],
) -> None:
    """One scan: trigger, pose and image of each pattern, the stage standing still."""
    bag.pose((0.0, 0.0, 0.0), start_ns - FRAME_NS)
    for index, file in enumerate(files):
        image = read_image(file, notes)
        if image.shape != first.shape or image.dtype != first.dtype:
            raise StackError(
                f"{file} is {_form(image)}; expected {_form(first)}, as the first image"
            )
        stamp_ns = start_ns + index * FRAME_NS
        bag.trigger(described.sequence, index, scan_id, stamp_ns, EXPOSURE_S)
        bag.pose((0.0, 0.0, 0.0), stamp_ns)
        bag.image(image, stamp_ns, stamp_ns + READOUT_NS)
        step()
    bag.pose((0.0, 0.0, 0.0), start_ns + len(files) * FRAME_NS)


def _form(image: NDArray[Any]) -> str:
    return f"{image.shape[1]} x {image.shape[0]} px, {image.dtype.itemsize * 8} bit"


def add_parser(subparsers: Any) -> None:
    """Register ``slrig import``."""
    parser = subparsers.add_parser(
        "import",
        description="Make a rosbag2 recording of a folder of images, in natural order of their "
        "names, one per pattern. A folder with sub-folders is several scans.",
        epilog="examples:\n"
        "  slrig import shots --sequence precise --output shots_bag\n"
        "  slrig import board --sequence examples/procam_board.yaml --output board_bag "
        "--calibration calibration.json",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of images")
    add("--sequence", required=True, metavar="NAME|FILE", help="what was projected")
    add("--output", required=True, type=Path, metavar="BAG", help="bag to be made")
    add("--storage", choices=("mcap", "sqlite3"), default="mcap")
    add("--calibration", type=Path, metavar="FILE", help="store this calibration in the bag")
    text = "DMD columns x rows of a built-in sequence (default 1024x768)"
    add("--dmd-size", type=dmd_size, metavar="WxH", help=text)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig import``."""
    described = find_sequence(args.sequence, args.dmd_size)
    calibration = None
    if args.calibration:
        size = described.sequence.dmd_size
        calibration = (args.calibration, lambda wh: load_calibration(args.calibration, wh, size))
    total = sum(len(image_files(scan)) for scan in scan_folders(args.folder))
    with ProgressLine("importing", total, "images") as progress:
        notes = import_folder(
            args.folder, described, args.output, args.storage, calibration, progress.step
        )
    for line in notes.lines:
        say(f"note: {line}")
    scans = total // len(described.sequence)
    say(f"{args.output}: {scans} scan{'s' if scans != 1 else ''}, {total} images")
    return 0
