"""The command line: instant help, ROS only where it is needed, errors in one line."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from sl_bringup.cli.main import COMMANDS, build_parser, main, module_of
from support.patience import patience

OFFLINE = ("patterns", "import", "evaluate")


def written(command: str) -> bool:
    return importlib.util.find_spec(module_of(command)) is not None


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if not written(command):
        pytest.skip(f"{command} is not there yet")
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert f"slrig {command}" in text
    assert "example" in text.lower()


def test_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    for name, line in COMMANDS.items():
        assert name in text
        assert line in text


@pytest.mark.parametrize("arguments", [[], ["scna"], ["import"], ["patterns", "paper"]])
def test_wrong_usage_is_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert "usage: slrig" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["patterns", "nonsense", "--output", "x"],
        ["import", "nowhere", "--sequence", "paper", "--output", "x"],
        ["evaluate", "nowhere", "--output", "x"],
        ["evaluate", "nowhere", "--output", "x", "--set", "estimator"],
    ],
)
def test_errors_are_one_line_and_status_1(
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    caught = capsys.readouterr()
    assert caught.out == ""
    assert caught.err.startswith("slrig: error: ")
    assert caught.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", OFFLINE)
def test_offline_commands_import_no_ros(command: str) -> None:
    code = (
        "import sys; from sl_bringup.cli.main import build_parser; "
        f"build_parser({command!r}); "
        "print([m for m in sys.modules if m.split('.')[0] in ('rclpy', 'sl_interfaces', "
        "'sensor_msgs', 'usb', 'serial')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={"PYTHONPATH": ":".join(sys.path)}, timeout=patience(120.0),
    )  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from sl_bringup.cli.main import build_parser; build_parser(None); "
        "print([m for m in ('numpy', 'cv2', 'numba', 'rclpy', 'rosbags') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={"PYTHONPATH": ":".join(sys.path)}, timeout=patience(120.0),
    )  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_only_the_command_asked_for_is_imported() -> None:
    for name in OFFLINE:
        parser = build_parser(name)
        assert parser.prog == "slrig"
