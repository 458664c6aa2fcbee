"""The doctor: what is wrong is named with its remedy, and only then the status is not 0."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from sl_bringup.cli import doctor
from sl_bringup.cli.main import main
from sl_bringup.graph import doctor_checks, doctor_devices
from sl_bringup.graph.doctor_checks import Finding
from sl_bringup.graph.graph import GraphOptions
from sl_bringup.graph.graph_config import Changes, write_config
from sl_bringup.graph.transport import MIB


@pytest.fixture(autouse=True)
def without_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asking the graph takes seconds; the graph's own tests do it."""
    monkeypatch.setattr(doctor_checks, "graph", lambda _: [])


def subjects(findings: list[Finding], level: str) -> set[str]:
    return {f.subject for f in findings if f.level == level}


def test_a_bench_needs_no_hardware(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--bench"]) == 0
    assert "all is well" in capsys.readouterr().out


def test_missing_devices_are_named_with_their_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "rig.yaml"
    config.write_text(
        f"/sl/stage: {{ros__parameters: {{port: {tmp_path}/no_port}}}}\n"
        f"/sl/camera: {{ros__parameters: {{address: {tmp_path}/no_camera}}}}\n"
    )
    findings = doctor.examine(GraphOptions(config=config))
    assert {"stage", "camera", "calibration", "projector"} <= subjects(findings, "bad")
    assert all(f.remedy for f in findings if f.level == "bad")
    assert main(["doctor", "--config", str(config)]) == 1
    assert f"no port {tmp_path}/no_port" in capsys.readouterr().out


def test_a_broken_configuration_is_a_finding(tmp_path: Path) -> None:
    config = tmp_path / "rig.yaml"
    config.write_text("/sl/camera: 3")
    assert "configuration" in subjects(doctor.examine(GraphOptions(config=config)), "bad")


@pytest.mark.parametrize(("free", "level"), [(8 << 30, "ok"), (64 * MIB, "note"), (0, "bad")])
def test_shared_memory(monkeypatch: pytest.MonkeyPatch, free: int, level: str) -> None:
    monkeypatch.setattr(doctor_checks, "free_bytes", lambda: free)
    (finding,) = doctor_checks.shared_memory()
    assert finding.level == level


def test_a_missing_library_is_named_as_pip_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor_checks.LIBRARIES, "no_such_module", "no-such-library")
    (finding,) = doctor_checks.collected("libraries", doctor_checks.libraries)
    assert finding.level == "bad"
    assert "no-such-library" in finding.remedy


def test_a_check_that_fails_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> list[Finding]:
        raise OSError("broken")

    monkeypatch.setattr(doctor_checks, "python", fail)
    findings = doctor.examine(GraphOptions(bench=True))
    assert "broken" in next(f.text for f in findings if f.level == "bad")


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("uvc:/dev/no_such_video", "no /dev/no_such_video"),
        ("bag:/no/such/bag", "nothing at /no/such/bag"),
        ("firewire:1", "expected aravis:SERIAL"),
    ],
)
def test_cameras_that_are_not_there(tmp_path: Path, address: str, text: str) -> None:
    config = tmp_path / "rig.yaml"
    config.write_text(f"/sl/camera: {{ros__parameters: {{address: '{address}'}}}}\n")
    found = doctor_devices.devices(config, running=False)
    (finding,) = (f for f in found if f.subject == "camera")
    assert finding.level == "bad"
    assert text in finding.text
    assert finding.remedy


def test_the_reconstruction_is_told_where_twelve_bits_end(tmp_path: Path) -> None:
    config = tmp_path / "rig.yaml"
    for pixel_format, expected in (("mono12p", 4095), ("mono10", 1023), ("mono16", None)):
        config.write_text(f"/sl/camera: {{ros__parameters: {{pixel_format: {pixel_format}}}}}")
        made = yaml.safe_load(write_config(config, tmp_path, Changes()).read_text())
        reconstruct = made.get("/sl/reconstruct", {}).get("ros__parameters", {})
        assert reconstruct.get("saturation_dn") == expected
