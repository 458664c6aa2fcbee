"""Calibration files: bit-exact round trips, foreign formats, and everything that is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sl_bench.world.reference_rig import reference_rig
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import (
    Calibration,
    Covariance,
    dump_calibration,
    load_calibration,
    load_rig,
    parse_calibration,
    rig_hash,
    save_calibration,
)
from sl_reconstruct.model.rig import BrownConrady, Device, Rig
from support.paths import DATA
from support.scenes.rigs import odd_rig, rotation

BOARD = DATA / "procam_board"
needs_board = pytest.mark.skipif(not BOARD.is_dir(), reason=f"no data in {BOARD}")


def document(rig: Rig | None = None) -> dict:
    """The file's content as plain data, without the hash so that it may be changed."""
    content = yaml.safe_load(dump_calibration(rig or reference_rig()))
    del content["hash"]
    return content


def refusal(content: object) -> str:
    """The message with which a document is refused."""
    with pytest.raises(CalibrationError) as caught:
        parse_calibration(yaml.safe_dump(content), "cal.yaml")
    return str(caught.value)


@pytest.mark.parametrize("rig", [reference_rig(), odd_rig()], ids=["division", "brown_conrady"])
def test_round_trip_keeps_every_bit(tmp_path: Path, rig: Rig) -> None:
    save_calibration(tmp_path / "cal.yaml", rig)
    back = load_rig(tmp_path / "cal.yaml")
    for a, b in ((rig.camera, back.camera), (rig.projector, back.projector)):
        assert a.lens == b.lens
        assert (a.image_size, a.focal_length_px, a.image_centre_px, a.pixel_pitch_m) == (
            b.image_size, b.focal_length_px, b.image_centre_px, b.pixel_pitch_m,
        )  # fmt: skip
        assert np.array_equal(a.rotation, b.rotation)
        assert np.array_equal(a.translation_m, b.translation_m)
    assert rig_hash(back) == rig_hash(rig)
    assert [p.name for p in tmp_path.iterdir()] == ["cal.yaml"]


def test_evidence_comes_back(tmp_path: Path) -> None:
    made = Calibration(
        reference_rig(),
        Covariance(("camera.kappa", "projector.kappa"), np.array([[4e-20, 1e-21], [1e-21, 9e-20]])),
        {"camera_rms_px": 0.03, "holes": [100, 98]},
        {"date": "2026-11-22", "views": 6},
    )
    save_calibration(tmp_path / "cal.yaml", made)
    back = load_calibration(tmp_path / "cal.yaml")
    assert back.covariance is not None
    assert back.covariance.parameters == made.covariance.parameters
    assert np.array_equal(back.covariance.matrix, made.covariance.matrix)
    assert back.residuals == made.residuals
    assert back.made_from == made.made_from


def test_file_is_what_the_design_says() -> None:
    content = yaml.safe_load(dump_calibration(reference_rig()))
    assert content["format"] == 1
    assert content["projector"]["model"] == "division"
    assert content["projector"]["kappa"] == 3.76e-8
    assert content["projector"]["image_size"] == [1024, 768]
    assert content["projector"]["image_centre_px"] == [28.93, 479.42]
    assert content["projector"]["pixel_pitch_m"] == 13.68e-6
    # 95.665 mm over 13.68 um, the paper's Table 1
    assert content["projector"]["focal_length_px"] == pytest.approx(95.665 / 0.01368, rel=1e-15)


def test_a_file_typed_by_hand_is_read() -> None:
    text = """
format: 1
camera: {model: brown_conrady, distortion: [-0.1, 0.02, 0, 0, 0], image_size: [1280, 1024],
  focal_length_px: [3442, 3443.5], pixel_pitch_m: 5.2e-6, image_centre_px: [620, 530],
  rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation_m: [0, 0, 0]}
projector: {model: division, kappa: 3e-8, image_size: [1024, 768], focal_length_px: 1888,
  pixel_pitch_m: 1368e-8, image_centre_px: [511.5, 850],
  rotation: [[0.9659, 0, 0.2588], [0, 1, 0], [-0.2588, 0, 0.9659]],
  translation_m: [-0.3, 0.0, 0.08]}
"""
    rig = parse_calibration(text).rig
    assert rig.camera.focal_length_px == (3442.0, 3443.5)
    assert rig.projector.lens.kappa == 3e-8  # PyYAML alone reads 3e-8 as a string
    assert rig.projector.pixel_pitch_m == 1368e-8
    # 15 degrees typed with four digits: 0.9659^2 + 0.2588^2 = 0.99994; taken to the nearest
    # rotation, which is the one about y by atan2(0.2588, 0.9659).
    angle = np.arctan2(0.2588, 0.9659)
    expected = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    np.testing.assert_allclose(rig.projector.rotation, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (("camera", "focal_lenght_px"), 3.0, "unknown key focal_lenght_px"),
        (("camera", "distortion"), [0, 0, 0, 0, 0], "does not know"),
        (("extra",), 1, "unknown key extra"),
        (("format",), 2, "format 2"),
        (("format",), "1", "whole number"),
        (("camera", "kappa"), "small", "finite number"),
        (("camera", "kappa"), float("nan"), "finite number"),
        (("camera", "kappa"), True, "finite number"),
        (("camera", "image_size"), [1600], "[width, height]"),
        (("camera", "image_size"), [1600.0, 1200.0], "whole number"),
        (("camera", "image_size"), [0, 1200], "at least 1 x 1"),
        (("camera", "rotation"), [[1, 0, 0], [0, 1, 0]], "expected 3"),
        (("camera", "translation_m"), [0, 0], "expected 3"),
        (("camera", "translation_m"), "0 0 1", "expected a list"),
        (("camera", "model"), "pinhole", "division or brown_conrady"),
        (("projector",), [1, 2], "expected a mapping"),
    ],
)
def test_unknown_keys_and_wrong_types_are_refused(
    path: tuple[str, ...], value: object, told: str
) -> None:
    content = document()
    target = content
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    message = refusal(content)
    assert told in message
    assert path[-1] in message


@pytest.mark.parametrize("device", ["camera", "projector"])
@pytest.mark.parametrize(
    ("key", "factor", "told"),
    [
        ("translation_m", 1e3, "translation_m"),  # millimetres
        ("pixel_pitch_m", 1e3, "pixel_pitch_m"),  # millimetres
        ("pixel_pitch_m", 1e6, "pixel_pitch_m"),  # micrometres
        ("focal_length_px", 13.68e-3, "focal_length_px"),  # millimetres
        ("focal_length_px", 13.68e-6, "focal_length_px"),  # metres
        ("kappa", 1e6 / 13.68**2, "kappa is in px^-2"),  # mm^-2
        ("kappa", -1e3, "kappa is in px^-2"),
        ("image_centre_px", 1e3, "image_centre_px"),
    ],
)
def test_units_mistaken_are_refused(device: str, key: str, factor: float, told: str) -> None:
    content = document()
    value = content[device][key]
    content[device][key] = (
        [factor * v for v in value] if isinstance(value, list) else factor * value
    )
    message = refusal(content)
    assert told in message
    assert "expected" in message


def test_translations_a_thousand_times_too_small_are_refused() -> None:
    content = document()
    for device in ("camera", "projector"):
        content[device]["translation_m"] = [1e-3 * v for v in content[device]["translation_m"]]
    assert "distance between camera and projector" in refusal(content)


def test_devices_that_look_away_from_each_other_are_refused() -> None:
    content = document()
    camera = content["camera"]
    # Turning the camera by 180 degrees about its own x axis leaves its position where it was
    # when the translation turns as well.
    flip = np.diag([1.0, -1.0, -1.0])
    camera["rotation"] = (flip @ np.array(camera["rotation"])).tolist()
    camera["translation_m"] = (flip @ np.array(camera["translation_m"])).tolist()
    assert "look away" in refusal(content)


def test_rotation_that_is_none_is_refused() -> None:
    content = document()
    content["camera"]["rotation"][0][0] += 1e-3
    assert "off orthonormal" in refusal(content)
    content = document()
    content["camera"]["rotation"] = (-np.array(content["camera"]["rotation"])).tolist()
    assert "det -1" in refusal(content)


def test_every_missing_key_is_named() -> None:
    for device in ("camera", "projector"):
        for key in document()[device]:
            content = document()
            del content[device][key]
            assert f"{device} lacks the key {key}" in refusal(content)
    for key in ("format", "camera", "projector"):
        content = document()
        del content[key]
        assert f"lacks the key {key}" in refusal(content)


def test_a_repeated_key_is_refused() -> None:
    text = dump_calibration(reference_rig()).replace("  kappa: 1.2e-08\n", "  kappa: 1.2e-08\n" * 2)
    with pytest.raises(CalibrationError, match="'kappa' is there twice"):
        parse_calibration(text)


def test_a_file_cut_anywhere_is_refused_or_whole() -> None:
    text = dump_calibration(reference_rig())
    rig, end = rig_hash(reference_rig()), text.index("hash:")
    for length in range(len(text) - 1):
        try:
            read = parse_calibration(text[:length])
        except CalibrationError:
            continue
        # All numbers are there: cut between the last of them and the hash.
        assert end - 1 <= length <= end
        assert read.hash == rig


def test_a_changed_number_is_noticed_by_the_hash() -> None:
    text = dump_calibration(reference_rig()).replace("28.93", "28.94")
    with pytest.raises(CalibrationError, match="changed or cut"):
        parse_calibration(text)


def test_hash_depends_on_every_number() -> None:
    rig = reference_rig()
    changed = [
        replace(rig.camera, image_size=(1600, 1201)),
        replace(rig.camera, pixel_pitch_m=np.nextafter(rig.camera.pixel_pitch_m, 1)),
        replace(rig.camera, focal_length_px=(rig.camera.focal_length_px[0], 16912.0)),
        replace(rig.camera, translation_m=rig.camera.translation_m + np.array([0, 0, 1e-12])),
        replace(rig.camera, lens=BrownConrady()),
    ]
    hashes = {rig_hash(Rig(camera, rig.projector)) for camera in [rig.camera, *changed]}
    assert len(hashes) == 6
    assert all(len(h) == 64 for h in hashes)


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n\x1a\n\x00\xff", b"[1, 2", b"just words", b"{", b"<?xml?><a>"]
)
def test_what_is_no_calibration_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(CalibrationError):
        load_calibration(tmp_path / "file")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="No such file"):
        load_calibration(tmp_path / "none.yaml")


def test_an_implausible_rig_is_not_written(tmp_path: Path) -> None:
    rig = reference_rig()
    far = replace(rig.camera, translation_m=rig.camera.translation_m * 1000)
    with pytest.raises(CalibrationError, match="translation_m"):
        save_calibration(tmp_path / "cal.yaml", Rig(far, rig.projector))
    assert list(tmp_path.iterdir()) == []


def stereo_files(folder: Path) -> list[Path]:
    """The same rig as OpenCV writes it, as XML, YAML and JSON, in millimetres."""
    matrices = {
        "cam_int": np.array([[3442.0, 0, 620], [0, 3443, 530], [0, 0, 1]]),
        "cam_dist": np.array([[-0.25, 0.24, 0.001, -0.002, 0.0]]),
        "proj_int": np.array([[1888.0, 0, 511], [0, 1887, 850], [0, 0, 1]]),
        "proj_dist": np.array([[-0.15], [0.21], [0.0], [0.0]]),
        "rotation": rotation(0.01, -0.06, -0.02),
        "translation": np.array([[95.65], [-623.89], [-240.0]]),
        "img_shape": np.array([[1024.0], [1280.0]]),
    }
    paths = [folder / "rig.xml", folder / "rig.yaml", folder / "rig.json"]
    for path in paths[:2]:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for key, matrix in matrices.items():
            storage.write(key, matrix)
        storage.release()
    plain = {key: matrix.tolist() for key, matrix in matrices.items()}
    paths[2].write_text(json.dumps({**plain, "units": "mm"}))
    return paths


def test_opencv_files_are_read_alike(tmp_path: Path) -> None:
    for path in stereo_files(tmp_path):
        rig = load_rig(path, projector_size=(1024, 768))
        assert rig.camera.image_size == (1280, 1024)
        assert np.array_equal(rig.camera.rotation, np.eye(3))
        assert rig.camera.lens == BrownConrady((-0.25, 0.24, 0.001, -0.002, 0.0))
        assert rig.projector.lens == BrownConrady((-0.15, 0.21, 0.0, 0.0, 0.0))
        assert rig.projector.focal_length_px == (1888.0, 1887.0)
        np.testing.assert_allclose(
            rig.projector.translation_m, [0.09565, -0.62389, -0.24], rtol=1e-14
        )
        # A point projects as OpenCV says.
        point_m = np.array([[0.2, 0.1, 3.4]])
        expected, _ = cv2.projectPoints(
            point_m, rig.projector.rotation, rig.projector.translation_m,
            rig.projector.camera_matrix, np.array(rig.projector.lens.coefficients),
        )  # fmt: skip
        np.testing.assert_allclose(rig.projector.project(point_m), expected[0], atol=1e-8)


def test_opencv_file_without_a_size_needs_one(tmp_path: Path) -> None:
    path = stereo_files(tmp_path)[2]
    with pytest.raises(CalibrationError, match="size of the projector's image"):
        load_calibration(path)
    with pytest.raises(CalibrationError, match="1280 x 1024 px; expected 640 x 480"):
        load_calibration(path, camera_size=(640, 480), projector_size=(1024, 768))


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("proj_int", None, "no projector matrix"),
        ("translation", [1.0, 2.0], "expected \\(3,\\)"),
        ("rotation", np.ones((3, 3)).tolist(), "off orthonormal"),
        ("cam_dist", [0, 0, 0, 0, 0, 0.1], "no more than k1"),
        ("units", "inch", "inch"),
        ("cam_int", [["a"] * 3] * 3, "not numbers"),
        ("translation", [95650.0, -623890.0, -240000.0], "translation_m"),  # micrometres
    ],
)
def test_opencv_nonsense_is_refused(tmp_path: Path, key: str, value: object, told: str) -> None:
    path = stereo_files(tmp_path)[2]
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(CalibrationError, match=told):
        load_calibration(path, projector_size=(1024, 768))


def test_opencv_file_cut_in_half_is_refused(tmp_path: Path) -> None:
    for path in stereo_files(tmp_path):
        text = path.read_text()
        path.write_text(text[: len(text) // 2])
        with pytest.raises(CalibrationError):
            load_calibration(path, projector_size=(1024, 768))


@needs_board
def test_board_calibrations_become_files_of_ours(tmp_path: Path) -> None:
    for name in ("calibration.json", "wrong_calibration.xml"):
        read = load_calibration(BOARD / name, (1280, 1024), (1024, 768))
        save_calibration(tmp_path / "cal.yaml", read)
        again = load_calibration(tmp_path / "cal.yaml")
        assert again.hash == read.hash
        assert again.made_from["world"] == "camera frame"
    stated = json.loads((BOARD / "calibration.json").read_text())
    rig = load_rig(BOARD / "calibration.json", (1280, 1024), (1024, 768))
    np.testing.assert_allclose(rig.projector.translation_m * 1e3, stated["T"], rtol=1e-14)
    assert np.array_equal(rig.projector.rotation, stated["R"])


def test_a_device_without_plausible_lens_is_told_apart_from_a_good_one() -> None:
    rig = reference_rig()
    good = Device(
        rig.camera.image_size, rig.camera.focal_length_px, rig.camera.image_centre_px,
        rig.camera.pixel_pitch_m, rig.camera.rotation, rig.camera.translation_m,
        BrownConrady((0.01, 0, 0, 0, 0)),
    )  # fmt: skip
    dump_calibration(Rig(good, rig.projector))
    content = document(Rig(good, rig.projector))
    content["camera"]["distortion"] = [3000.0, 0, 0, 0, 0]
    assert "OpenCV's coefficients" in refusal(content)
