"""The doctor's look at devices: there, busy, forbidden, of another kind, sick; with the remedy."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import usb.core
import yaml

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from sl_bench.dlpc.usb_server import EmulatedUsb, UsbSocketServer
from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_bringup.graph import doctor_devices
from sl_bringup.graph.doctor_checks import Finding
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_projector.dlpc.dlpc900_driver import Dlpc900
from sl_projector.hid.usb_socket import LinkBackend


class Rig:
    """Emulated devices as a configuration names them, and what the doctor says of them."""

    def __init__(self, folder: Path) -> None:
        self.dmd = Dlpc900Emulator()
        self.usb = EmulatedUsb(self.dmd)
        self.socket = folder / "usb.sock"
        self.stage = GrblEmulator(homed=True)
        self.port = folder / "stage"
        self.config = folder / "rig.yaml"
        self.configure(f"socket:{self.socket}")

    def configure(self, device: str, **projector: str) -> None:
        nodes = {
            "projector": {"device": device, **projector},
            "stage": {"port": str(self.port)},
            "camera": {"address": ""},
        }
        document = {f"/sl/{name}": {"ros__parameters": p} for name, p in nodes.items()}
        self.config.write_text(yaml.safe_dump(document))

    def find(self, subject: str, running: bool = False) -> Finding:
        found = doctor_devices.devices(self.config, running)
        return next(f for f in found if f.subject == subject)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    server = UsbSocketServer(str(made.socket), made.usb)
    with made.stage:
        made.stage.link(made.port)
        yield made
    server.close()


@pytest.fixture
def on_usb(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """The same controller on the USB; its file is there, udev has no rule."""
    real, backend = usb.core.find, LinkBackend(rig.usb.connect())
    monkeypatch.setattr(usb.core, "find", lambda **how: real(**{**how, "backend": backend}))
    monkeypatch.setattr(doctor_devices, "USB_NODES", tmp_path)
    monkeypatch.setattr(doctor_devices, "RULES_DIRECTORIES", (tmp_path / "rules",))
    (tmp_path / "001").mkdir()
    (tmp_path / "001" / "001").touch()
    (tmp_path / "rules").mkdir()
    rig.configure("usb")
    return rig


def test_devices_that_are_well_say_how_they_are_and_stay_as_they_are(rig: Rig) -> None:
    standby = struct.pack("<BBHHB", 0x40, 1, 3, 0x0200, 1)
    rig.dmd.receive(standby.ljust(64, b"\0"))
    finding = rig.find("projector")
    assert (finding.level, "standby" in finding.text) == ("ok", True)
    assert "DLP5500 on a DLPC900" in finding.text
    power = rig.dmd.receive(struct.pack("<BBHH", 0xC0, 1, 2, 0x0200).ljust(64, b"\0"))
    assert power[0][4] == 1
    stage = rig.find("stage")
    assert (stage.level, "idle" in stage.text) == ("ok", True)
    assert "the running graph has it" in rig.find("stage", running=True).text


def test_a_socket_that_is_not_served_is_told(rig: Rig) -> None:
    rig.configure("socket:/no/such/socket")
    finding = rig.find("projector")
    assert (finding.level, finding.text) == ("bad", "nothing at /no/such/socket")
    assert "slrig up --bench" in finding.remedy


def test_what_the_configuration_leaves_out_is_another_drivers_or_not_there(rig: Rig) -> None:
    rig.config.write_text("/sl/projector:\n  ros__parameters: {device: 'socket:/no/such/socket'}\n")
    camera, stage = rig.find("camera"), rig.find("stage")
    assert (camera.level, stage.level) == ("note", "note")
    assert "camera/image_raw" in camera.text
    assert "require_pose: false" in stage.remedy


def test_a_stage_that_is_locked_or_mute_is_told(rig: Rig) -> None:
    rig.stage.power_cycle()
    finding = rig.find("stage")
    assert (finding.level, "not_homed" in finding.text) == ("note", True)
    assert "stage/home" in finding.remedy
    rig.stage.fall_silent()
    finding = rig.find("stage")
    assert (finding.level, "no grbl stage" in finding.text) == ("bad", True)
    assert "baud" in finding.remedy


def test_busy_devices_are_told(rig: Rig) -> None:
    projector, stage = Dlpc900(f"socket:{rig.socket}"), GrblStage(str(rig.port))
    projector.open()
    stage.open()
    for subject in ("projector", "stage"):
        finding = rig.find(subject)
        assert finding.level == "bad"
        assert "busy" in finding.text or "cannot open" in finding.text
        assert "stop" in finding.remedy
    projector.close()
    stage.close()


def test_the_program_that_has_a_port_is_named(rig: Rig) -> None:
    script = "import sys; f = open(sys.argv[1], 'rb', 0); print('open', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", script, str(rig.port)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as other:  # fmt: skip
        assert other.stdout is not None
        other.stdout.readline()
        finding = rig.find("stage")
        other.kill()
    assert finding.level == "bad"
    assert f"(process {other.pid})" in finding.text


def test_the_controller_of_the_configured_serial_number_is_looked_at(
    on_usb: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_usb.configure("usb:EMU0001")  # the emulator's own, see test_usb_socket.py
    assert on_usb.find("projector").level == "ok"
    on_usb.configure("usb:EMU0002")
    finding = on_usb.find("projector")
    assert finding.level == "bad"
    assert finding.text == "no DLPC900 of serial number 'EMU0002'; on the USB: EMU0001"
    # One that may not be opened keeps its serial number to itself: it may be the one.
    monkeypatch.setattr(doctor_devices, "_may_use", lambda node: node.name != "001")
    assert "no permission" in on_usb.find("projector").text


class Group:
    """An entry of the group database."""

    def __init__(self, name: str, members: list[str]) -> None:
        self.gr_name, self.gr_mem = name, members


def test_the_group_of_a_port_is_told(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not in it; in it but not logged in since; a number without a name, as in containers."""
    port = tmp_path / "ttyUSB0"
    port.touch()
    rig.port = port
    rig.configure(f"socket:{rig.socket}")
    number = port.stat().st_gid
    groups = {number: Group("dialout", [])}
    monkeypatch.setattr(doctor_devices, "_may_use", lambda node: node != port)
    monkeypatch.setattr(doctor_devices.grp, "getgrgid", groups.__getitem__)
    monkeypatch.setenv("USER", "ada")
    finding = rig.find("stage")
    assert (finding.level, finding.text) == ("bad", f"you have no permission for {port}")
    assert finding.remedy == "sudo usermod -aG dialout ada, then log out and in again"
    groups[number] = Group("dialout", ["ada"])
    assert "log in again" in rig.find("stage").remedy
    assert "usermod" not in rig.find("stage").remedy
    del groups[number]
    assert rig.find("stage").remedy == f"in a container: start it with --group-add {number}"


def test_a_controller_on_the_usb_without_permission(
    on_usb: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """First there is no rule; then there is one that is not in force."""
    assert on_usb.find("projector").level == "ok"
    real = doctor_devices._may_use
    monkeypatch.setattr(doctor_devices, "_may_use", lambda node: real(node) and node.name != "001")
    (rules,) = doctor_devices.RULES_DIRECTORIES
    shipped = Path(doctor_devices.RULES)
    (rules / "99-other.rules").write_text('# ATTR{idVendor}=="0451" ATTR{idProduct}=="c900"\n')
    finding = on_usb.find("projector")  # a comment is no rule
    assert finding.level == "bad"
    assert "no permission" in finding.text
    assert f"sudo cp {doctor_devices.RULES}" in finding.remedy
    (rules / shipped.name).write_text(shipped.read_text())
    finding = on_usb.find("projector")
    assert shipped.name in finding.text
    assert "udevadm" in finding.remedy
    assert "sudo cp" not in finding.remedy


def test_a_controller_on_the_usb_that_is_of_another_kind_or_sick(on_usb: Rig) -> None:
    on_usb.configure("usb", dmd_model="DLP4500")
    finding = on_usb.find("projector")
    assert "a DLPC900 is on the USB" in finding.text
    assert "dmd_model: DLP6500 or" in finding.remedy
    on_usb.configure("usb", dmd_model="DLP6500")
    assert "device has a DLP5500; expected DLP6500" in on_usb.find("projector").text
    on_usb.configure("usb", dmd_model="DLP1")
    assert "there are DLP4500" in on_usb.find("projector").text
    on_usb.configure("usb")
    on_usb.dmd.aborted = True
    finding = on_usb.find("projector")
    assert (finding.level, "sequencer aborted" in finding.text) == ("bad", True)
    on_usb.dmd.faults.taken = True
    assert "busy" in on_usb.find("projector").text
