"""``slrig measure`` on files of clouds, and the paper's naive decoding."""

import json
import os
import zipfile

import numpy as np
import pytest

from naive_decoding import naive
from sl_bench.world.reference_rig import reference_rig
from sl_bringup.cli.main import main
from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE
from sl_reconstruct.cloud.cloud_reader import read_cloud
from sl_reconstruct.cloud.cloud_writer import save_pcd, save_ply
from sl_reconstruct.cloud.height_map import make_height_map, save_tiff
from support.png_files import pixels
from support.scenes.measured_clouds import cloud


@pytest.fixture
def groove() -> np.ndarray:
    """A groove of slope 0.2 with a missing corner."""
    points = cloud(lambda x, y: 0.2 * np.abs(x), (40, 200)).astype(CLOUD_DTYPE)
    for name in CLOUD_DTYPE.names:
        points[name][:5, :5] = np.nan
    return points


#: 180 - 2 atan(0.2) degrees.
ANGLE_DEG = 157.3801


def test_clouds_come_back_from_their_files(groove, tmp_path) -> None:
    save_pcd(tmp_path / "whole.pcd", groove, organised=True)
    save_pcd(tmp_path / "points.pcd", groove)
    save_ply(tmp_path / "points.ply", groove)
    whole = read_cloud(tmp_path / "whole.pcd")
    assert whole.shape == groove.shape
    for field in CLOUD_DTYPE.names:
        np.testing.assert_array_equal(whole[field], groove[field])
    there = groove[np.isfinite(groove["z"])]
    for name in ("points.pcd", "points.ply"):
        back = read_cloud(tmp_path / name)
        assert back.shape == (40 * 200 - 25,)
        for field in CLOUD_DTYPE.names:
            np.testing.assert_array_equal(back[field], there[field])


def test_a_height_map_comes_back_with_the_grid_of_its_report(groove, tmp_path) -> None:
    height = make_height_map(groove)
    save_tiff(tmp_path / "height.tiff", height)
    with pytest.raises(ConfigError, match=r"report\.json"):
        read_cloud(tmp_path / "height.tiff")
    grid = {"x0_m": height.x0_m, "y0_m": height.y0_m, "step_m": height.step_m}
    (tmp_path / "report.json").write_text(json.dumps({"height_map": grid}))
    back = read_cloud(tmp_path / "height.tiff")
    there = np.isfinite(back["z"])
    # Between two points of noise 0.3 to 0.45 um: no node is further off than six of these.
    assert np.abs(back["z"] - 0.2 * np.abs(back["x"]))[there].max() < 0.2 * 2e-5 + 2.7e-6


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.npy", "a.tiff", "a.stl"])
def test_files_that_are_no_clouds_are_refused(name, tmp_path) -> None:
    with pytest.raises(ConfigError):
        read_cloud(tmp_path / name)
    (tmp_path / name).write_bytes(b"not a cloud at all\n" * 20)
    with pytest.raises(ConfigError):
        read_cloud(tmp_path / name)


def test_a_truncated_pcd_is_refused(groove, tmp_path) -> None:
    save_pcd(tmp_path / "a.pcd", groove)
    (tmp_path / "b.pcd").write_bytes((tmp_path / "a.pcd").read_bytes()[:-7])
    with pytest.raises(ConfigError, match="expected"):
        read_cloud(tmp_path / "b.pcd")


def test_measure_tells_value_uncertainty_and_verdict(groove, tmp_path, capsys) -> None:
    save_pcd(tmp_path / "cloud.pcd", groove, organised=True)
    found = tmp_path / "found.json"
    common = ["measure", str(tmp_path / "cloud.pcd"), "--groove", "--json", str(found)]
    assert main([*common, "--tolerance", "157.2:157.5"]) == 0
    result = json.loads(found.read_text())["measurements"][0]
    assert result["verdict"] == "pass"
    assert [q["name"] for q in result["quantities"]][:2] == ["included_angle", "first_a"]
    assert abs(result["value"] - ANGLE_DEG) < 4 * result["uncertainty"]
    assert "157.3" in capsys.readouterr().out
    assert main([*common, "--tolerance", ":157.0"]) == 1
    assert json.loads(found.read_text())["measurements"][0]["verdict"] == "fail"
    capsys.readouterr()
    # Slopes have no unit; c is a length, in micrometres: 0 at the groove's bottom, to noise.
    slope = ["--quantity", "first_a", "--tolerance=-0.21:-0.19"]
    assert main([*common, *slope]) == 0
    assert "pass (first_a)" in capsys.readouterr().out
    assert main([*common, "--quantity", "first_c", "--tolerance=-0.5:0.5"]) == 0
    assert main([*common, "--quantity", "first_c", "--tolerance=0.5:1e3"]) == 1
    assert main([*common, "--quantity", "radius", "--tolerance=0:1"]) == 1
    assert "angle has no quantity 'radius'" in capsys.readouterr().err


def test_every_measurement_has_its_option(groove, tmp_path, capsys) -> None:
    save_pcd(tmp_path / "cloud.pcd", groove, organised=True)
    os.utime(tmp_path / "cloud.pcd", (1.7e9, 1.7e9))
    section = tmp_path / "section.csv"
    status = main([
        "measure", str(tmp_path / "cloud.pcd"), "--plane=-1.5,-1,-0.5,1",
        "--angle=-1.5,-1,-0.5,1,0.5,-1,1.5,1", "--profile=-1.5,0,1.5,0,0.5",
        "--csv", str(section), "--x3p", str(tmp_path / "map.x3p"),
    ])  # fmt: skip
    assert status == 0
    out = capsys.readouterr().out
    assert "flatness" in out
    assert "Z = -0.2000" in out
    assert "included angle" in out
    assert section.is_file()
    with zipfile.ZipFile(tmp_path / "map.x3p") as archive:  # dated as the cloud, not as the export
        assert b"<Date>2023-11-14T22:13:20+00:00</Date>" in archive.read("main.xml")


@pytest.mark.parametrize(
    "options",
    [[], ["--tolerance", "1:2"], ["--plane=0,0,1"], ["--csv", "x.csv", "--groove"],
     ["--plane=50,50,60,60"], ["--angle=0,0,1,1"], ["--groove", "--picture", "x.png"],
     ["--groove", "--region=0,0,1,1"], ["--groove", "--quantity", "first_a"]],
)  # fmt: skip
def test_requests_that_make_no_sense_are_refused(options, groove, tmp_path, capsys) -> None:
    save_pcd(tmp_path / "cloud.pcd", groove, organised=True)
    assert main(["measure", str(tmp_path / "cloud.pcd"), *options]) == 1
    assert "expected" in capsys.readouterr().err


def test_a_map_of_deviations_and_a_section_are_drawn(groove, tmp_path, capsys) -> None:
    """A bump of 3 um on the groove: red where it is, and nothing anywhere else of that colour."""
    save_pcd(tmp_path / "cloud.pcd", groove, organised=True)
    height = make_height_map(groove)
    save_tiff(tmp_path / "height.tiff", height)
    grid = {"x0_m": height.x0_m, "y0_m": height.y0_m, "step_m": height.step_m}
    (tmp_path / "report.json").write_text(json.dumps({"height_map": grid}))
    bumped = groove.copy()
    bumped["z"] += 3e-6 * (np.hypot(groove["x"] - 1e-3, groove["y"]) < 0.4e-3)
    save_pcd(tmp_path / "bumped.pcd", bumped, organised=True)
    common = ["measure", str(tmp_path / "bumped.pcd"), "--reference", str(tmp_path / "height.tiff")]
    assert main([*common, "--picture", str(tmp_path / "map.png")]) == 0
    red, green, blue = np.moveaxis(pixels((tmp_path / "map.png").read_bytes()).astype(int), -1, 0)
    rows, columns = np.nonzero((red - blue > 60) & (red - green > 60))
    inside = columns < 0.8 * red.shape[1]  # right of it is the colour bar
    # x = 1 mm of -2 to 2 mm: three quarters of the way across the axes.
    assert 0.5 < columns[inside].mean() / (0.8 * red.shape[1]) < 0.9
    assert 0.3 < rows[inside].mean() / red.shape[0] < 0.7
    assert "form" in capsys.readouterr().out
    here = ["--region=-1.8,-1,-0.2,1", "--json", str(tmp_path / "found.json")]
    assert main([*common, *here]) == 0
    found = json.loads((tmp_path / "found.json").read_text())["measurements"][0]
    # The bump lies outside; both sides have the same noise, and the map's interpolation at a slope.
    assert found["peak_m"] < 2e-6 and len(found["region"]["corners_m"]) == 4
    section = ["--profile=-1.5,0,1.5,0,0.5", "--picture", str(tmp_path / "section.png")]
    assert main(["measure", str(tmp_path / "cloud.pcd"), *section]) == 0
    assert min(pixels((tmp_path / "section.png").read_bytes()).shape[:2]) > 200


def test_an_unorganised_cloud_says_what_it_cannot_give(groove, tmp_path, capsys) -> None:
    save_ply(tmp_path / "cloud.ply", groove)
    assert main(["measure", str(tmp_path / "cloud.ply"), "--groove"]) == 1
    assert "organised" in capsys.readouterr().err
    assert main(["measure", str(tmp_path / "cloud.ply"), "--plane=-1.5,-1,-0.5,1"]) == 0


def test_naive_decoding_finds_the_plane_to_a_pixel() -> None:
    """Stripes painted on z = 0 by the rig's own model: every border is found within a pixel.

    Half a camera pixel is 4 um of u, and sin(32.6 deg) of height per distance: at most 8 um of z.
    """
    rig = reference_rig()
    rows = np.arange(500, 520, 5)
    u, v = np.meshgrid(np.arange(1600.0), rows)
    q = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, origin = rig.camera.rays(q), rig.camera.position_m
    on_plane = origin - (origin[2] / rays[:, 2:]) * rays
    column = np.rint(rig.projector.project(on_plane)[:, 0]).astype(int).reshape(u.shape)
    inside = (column >= 0) & (column < 1024)
    stack = np.zeros((11, 1200, 1600), dtype=np.uint8)
    for index in range(8):
        lit = named("paper").frame(index)[0] != 0
        stack[index][rows] = 200 * (lit[np.clip(column, 0, 1023)] & inside)
    points = naive(rig, stack)
    found = points["z"][rows]
    assert np.isfinite(found).mean() > 0.95
    assert np.nanmax(np.abs(found)) < 8e-6
