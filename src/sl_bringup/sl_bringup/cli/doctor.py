"""``slrig doctor``: what is missing on this machine, and the remedy."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Any

from sl_bringup.graph import doctor_checks as checks
from sl_bringup.graph.console import say
from sl_bringup.graph.doctor_checks import Finding
from sl_bringup.graph.graph import GraphOptions, is_running
from sl_bringup.graph.graph_arguments import add_graph_arguments, graph_options

_MARKS = {"ok": "ok  ", "note": "note", "bad": "BAD "}


def examine(options: GraphOptions) -> list[Finding]:
    """Check everything; a check that fails by itself is a finding too."""
    steps: dict[str, Callable[[], Iterable[Finding]]] = {
        "python": checks.python,
        "libraries": checks.libraries,
        "ROS": checks.ros,
        "shared memory": checks.shared_memory,
        "configuration": lambda: checks.configuration(options),
        "devices": lambda: _devices(options),
        "graph": lambda: checks.graph(options),
    }
    return [f for subject, step in steps.items() for f in checks.collected(subject, step)]


def _devices(options: GraphOptions) -> list[Finding]:
    if options.bench:
        return []
    # Imported late: the drivers need libraries that may be what is missing.
    from sl_bringup.graph.doctor_devices import devices

    return devices(options.source, is_running(options.directory))


def add_parser(subparsers: Any) -> None:
    """Register ``slrig doctor``."""
    parser = subparsers.add_parser(
        "doctor",
        description="Check Python, libraries, ROS, shared memory, configuration, devices and the "
        "running graph. Devices are asked how they are and never moved; those of a running graph "
        "are left alone: its nodes report. (An Arduino at a serial port restarts when opened.) "
        "With --bench nothing about hardware is asked for. The exit status is 0 when nothing that "
        "is needed is missing.",
        epilog="examples:\n  slrig doctor --bench\n  slrig doctor --config my_rig.yaml",
    )
    add_graph_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig doctor``."""
    findings = examine(graph_options(args))
    for finding in findings:
        say(f"{_MARKS[finding.level]} {finding.subject:<14} {finding.text}")
        if finding.remedy:
            say(f"{'':<19} -> {finding.remedy}")
    bad = sum(finding.level == "bad" for finding in findings)
    say(f"{bad} thing{'s' if bad != 1 else ''} to fix" if bad else "all is well")
    return 1 if bad else 0
