"""``slrig patterns`` and ``slrig import``: folders of images to and fro."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_bringup.bag.bags import open_bag
from sl_bringup.cli.import_images import import_folder, scan_folders
from sl_bringup.cli.main import main
from sl_common.errors import BagError, StackError
from sl_common.messages import stamp_from_msg
from sl_common.topics import CALIBRATION, IMAGE, POSE, TRIGGER
from sl_projector.sequence.pattern_sequence import named
from sl_projector.sequence.sequence_file import SequenceFile, load_sequence_file
from sl_reconstruct.model.calibration_file import rig_hash, save_calibration
from support.scenes.rigs import CAMERA_SIZE, DMD_SIZE, tiny_rig
from support.scenes.tiny_scans import render, tiny_sequence, write_images

DMD = "x".join(map(str, DMD_SIZE))


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return render(tiny_sequence("precise"))


def described(files: tuple[str | None, ...] | None = None) -> SequenceFile:
    sequence = tiny_sequence("precise")
    return SequenceFile(sequence, files or (None,) * len(sequence))


def images_of(bag: Path) -> list[np.ndarray]:
    with open_bag(bag) as opened:
        return [
            r.message.data.reshape(r.message.height, r.message.width)
            for r in opened.messages(IMAGE)
        ]


@pytest.mark.parametrize("name", ["paper", "precise-rows"])
def test_patterns_are_the_frames_in_order(tmp_path: Path, name: str) -> None:
    assert main(["patterns", name, "--output", str(tmp_path / "p"), "--dmd-size", "912x1140"]) == 0
    sequence = named(name, (912, 1140))
    read = load_sequence_file(tmp_path / "p" / "sequence.yaml")
    assert read.sequence == sequence
    pngs = sorted(p.name for p in (tmp_path / "p").glob("*.png"))
    assert pngs == list(read.files)  # plain alphabetical order is the order of projection
    for i, file in enumerate(pngs):
        frame = cv2.imread(str(tmp_path / "p" / file), cv2.IMREAD_UNCHANGED)
        assert frame.dtype == np.uint8
        assert np.array_equal(frame, sequence.frame(i))


def test_patterns_refuse_to_mix_with_other_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["patterns", "paper", "--output", str(tmp_path)]) == 0
    assert main(["patterns", "paper", "--output", str(tmp_path)]) == 0
    assert main(["patterns", "precise", "--output", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "other images" in error
    assert error.count("\n") == 1


def test_images_come_in_natural_order_with_their_triggers(
    tmp_path: Path, frames: np.ndarray
) -> None:
    write_images(tmp_path / "shots", frames)  # shot_10.png sorts before shot_2.png
    import_folder(tmp_path / "shots", described(), tmp_path / "a")
    for image, frame in zip(images_of(tmp_path / "a"), frames, strict=True):
        assert np.array_equal(image, frame)
    with open_bag(tmp_path / "a") as bag:
        triggers = [r.message for r in bag.messages(TRIGGER)]
        stamps = [stamp_from_msg(r.message.header.stamp) for r in bag.messages(IMAGE)]
        poses = [stamp_from_msg(r.message.header.stamp) for r in bag.messages(POSE)]
    sequence = tiny_sequence("precise")
    for i, trigger in enumerate(triggers):
        assert (trigger.index, trigger.count, trigger.scan_id) == (i, len(sequence), 1)
        assert (trigger.dmd_columns, trigger.dmd_rows) == DMD_SIZE
        assert trigger.pattern.bit == sequence.patterns[i].bit
        assert stamp_from_msg(trigger.header.stamp) == stamps[i]
    assert poses[0] < stamps[0]
    assert poses[-1] > stamps[-1] + 20_000_000  # the stage is known to stand beyond the exposure


def test_the_same_import_is_the_same_bytes(tmp_path: Path, frames: np.ndarray) -> None:
    write_images(tmp_path / "shots", frames)
    for folder in ("1", "2"):
        import_folder(tmp_path / "shots", described(), tmp_path / folder / "a")
    first, second = (tmp_path / folder / "a" / "a.mcap" for folder in ("1", "2"))
    assert first.read_bytes() == second.read_bytes()


def test_sub_folders_are_scans(tmp_path: Path, frames: np.ndarray) -> None:
    for name in ("part 10", "part 9"):
        write_images(tmp_path / "shots" / name, frames)
    (tmp_path / "shots" / "notes").mkdir()
    assert [p.name for p in scan_folders(tmp_path / "shots")] == ["part 9", "part 10"]
    import_folder(tmp_path / "shots", described(), tmp_path / "a", "sqlite3")
    with open_bag(tmp_path / "a") as bag:
        ids = [r.message.scan_id for r in bag.messages(TRIGGER)]
    assert ids == [1] * len(frames) + [2] * len(frames)
    write_images(tmp_path / "shots", frames[:1])
    with pytest.raises(StackError, match=r"1 images and sub-folders.*part 9, part 10"):
        scan_folders(tmp_path / "shots")


def test_a_sequence_file_may_name_the_images(tmp_path: Path, frames: np.ndarray) -> None:
    names = tuple(f"{'zyxwvutsrqponmlkjihgfedcba'[i]}.png" for i in range(len(frames)))
    for name, frame in zip(names, frames, strict=True):
        write_images(tmp_path / "shots", frame[np.newaxis], name)
    write_images(tmp_path / "shots", frames[:1], "another.png")
    import_folder(tmp_path / "shots", described(names), tmp_path / "a")
    for image, frame in zip(images_of(tmp_path / "a"), frames, strict=True):
        assert np.array_equal(image, frame)
    (tmp_path / "shots" / names[3]).unlink()
    with pytest.raises(StackError, match=f"lacks 1 of the 22 images.*{names[3]}"):
        import_folder(tmp_path / "shots", described(names), tmp_path / "b")


def test_names_that_nobody_has_do_not_matter(tmp_path: Path, frames: np.ndarray) -> None:
    """``slrig patterns`` notes its own frames' names; photographs of them are called otherwise."""
    write_images(tmp_path / "shots", frames)
    names = tuple(f"{i:03d}_frame.png" for i in range(len(frames)))
    import_folder(tmp_path / "shots", described(names), tmp_path / "a")
    assert len(images_of(tmp_path / "a")) == len(frames)


def test_wrong_count_names_both_numbers(tmp_path: Path, frames: np.ndarray) -> None:
    write_images(tmp_path / "shots", frames[:-1])
    with pytest.raises(StackError, match="has 21 images; expected 22"):
        import_folder(tmp_path / "shots", described(), tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_wrong_size_and_depth_name_both(tmp_path: Path, frames: np.ndarray) -> None:
    write_images(tmp_path / "shots", frames)
    cv2.imwrite(str(tmp_path / "shots" / "shot_4.png"), frames[4, :-1])
    with pytest.raises(StackError, match=r"shot_4.png is 320 x 119.*expected 320 x 120 px, 8 bit"):
        import_folder(tmp_path / "shots", described(), tmp_path / "a")
    cv2.imwrite(str(tmp_path / "shots" / "shot_4.png"), frames[4].astype(np.uint16))
    with pytest.raises(StackError, match=r"16 bit; expected .* 8 bit"):
        import_folder(tmp_path / "shots", described(), tmp_path / "a")
    assert [p.name for p in tmp_path.iterdir()] == ["shots"]


@pytest.mark.parametrize("content", [b"", b"no image", None])
def test_unreadable_images_are_named(
    tmp_path: Path, frames: np.ndarray, content: bytes | None
) -> None:
    write_images(tmp_path / "shots", frames)
    file = tmp_path / "shots" / "shot_7.png"
    file.write_bytes(file.read_bytes()[:200] if content is None else content)
    with pytest.raises(StackError, match=r"shot_7\.png"):
        import_folder(tmp_path / "shots", described(), tmp_path / "a")


def test_floating_point_images_are_refused(tmp_path: Path, frames: np.ndarray) -> None:
    for i, frame in enumerate(frames):
        (tmp_path / "shots").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "shots" / f"{i}.tiff"), frame.astype(np.float32))
    with pytest.raises(StackError, match="float32 pixels; expected 8 or 16 bit"):
        import_folder(tmp_path / "shots", described(), tmp_path / "a")


def test_colour_becomes_grey_with_a_note(tmp_path: Path, frames: np.ndarray) -> None:
    colour = np.repeat(frames[..., np.newaxis], 3, axis=-1)
    write_images(tmp_path / "equal", colour)
    notes = import_folder(tmp_path / "equal", described(), tmp_path / "a")
    assert "equal colour channels" in notes.lines[0]
    assert np.array_equal(images_of(tmp_path / "a"), frames)
    colour[..., 0] //= 2  # OpenCV's order: blue
    write_images(tmp_path / "colour", colour)
    notes = import_folder(tmp_path / "colour", described(), tmp_path / "b")
    assert "0.299 R + 0.587 G + 0.114 B" in notes.lines[0]
    expected = 0.886 * frames + 0.114 * (frames // 2)
    # OpenCV computes in fixed point: the result is rounded to within one grey value.
    assert np.abs(np.array(images_of(tmp_path / "b")) - expected).max() <= 1.0


def test_sixteen_bits_survive(tmp_path: Path, frames: np.ndarray) -> None:
    wide = frames.astype(np.uint16) * 257 + 1
    write_images(tmp_path / "shots", wide)
    import_folder(tmp_path / "shots", described(), tmp_path / "a")
    with open_bag(tmp_path / "a") as bag:
        got = [np.frombuffer(r.message.data, "<u2") for r in bag.messages(IMAGE)]
    assert np.array_equal(np.array(got).reshape(wide.shape), wide)


@pytest.mark.parametrize("folder", ["empty", "missing"])
def test_no_images_are_refused(tmp_path: Path, folder: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(StackError, match=f"{folder} (has no images|is not a folder)"):
        import_folder(tmp_path / folder, described(), tmp_path / "a")


def test_command_line_stores_the_calibration(
    tmp_path: Path, frames: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    write_images(tmp_path / "shots", frames)
    save_calibration(tmp_path / "cal.yaml", tiny_rig())
    arguments = ["import", str(tmp_path / "shots"), "--sequence", "precise", "--dmd-size", DMD]
    arguments += ["--output", str(tmp_path / "a"), "--calibration", str(tmp_path / "cal.yaml")]
    assert main(arguments) == 0
    assert "1 scan, 22 images" in capsys.readouterr().out
    with open_bag(tmp_path / "a") as bag:
        message = next(bag.messages(CALIBRATION)).message
    assert message.hash == rig_hash(tiny_rig())
    assert (message.camera.width, message.camera.height) == CAMERA_SIZE
    assert main(arguments) == 1
    assert "exists already" in capsys.readouterr().err


def test_an_unwritable_place_is_an_error(tmp_path: Path, frames: np.ndarray) -> None:
    write_images(tmp_path / "shots", frames)
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot write"):
        import_folder(tmp_path / "shots", described(), tmp_path / "file" / "a")
