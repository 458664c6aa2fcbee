"""``slrig calibrate``: calibrate the rig with the running graph, or stored observations again."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sl_bringup.graph.client_process import run_client
from sl_bringup.graph.console import complain, say
from sl_bringup.graph.graph import Graph, GraphOptions, client_command
from sl_bringup.graph.graph_arguments import (
    add_graph_arguments,
    add_waiting_arguments,
    graph_options,
)
from sl_bringup.results.calibration_lines import outcome_lines
from sl_common.documents import read_document
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.calibrate_node"


def add_parser(subparsers: Any) -> None:
    """Register ``slrig calibrate``."""
    parser = subparsers.add_parser(
        "calibrate",
        description="Ask the graph to calibrate: the plate at several heights, camera and "
        "projector, uncertainty, verdict, report. The exit status is 0 only when a calibration "
        "was accepted and is in force. With --from, a recording (slrig record, during the run) or "
        "the observations in a run's folder are solved again, without a graph; nothing is put in "
        "force then.",
        epilog="examples:\n"
        "  slrig calibrate\n"
        "  slrig calibrate --heights-mm -1 -0.5 0 0.5 1\n"
        "  slrig calibrate --target projector\n"
        "  slrig calibrate --verify --heights-mm -0.8 0 0.8\n"
        "  slrig calibrate --from calibrations/2026-01-31_120000_run --output again\n"
        "  slrig calibrate --from recorded_bag --output again\n"
        "  slrig calibrate --from calibrations/2026-01-31_120000_run --opencv rig.xml\n"
        "  slrig calibrate --up --bench --surface hole_plate",
    )
    add = parser.add_argument
    text = "solve this run's folder, or the calibration in this recording, again, offline"
    add("--from", dest="source", type=Path, metavar="RUN|BAG", help=text)
    add("--output", type=Path, metavar="DIR", help="with --from: for the results")
    text = "with --from: write the run's calibration for OpenCV (.xml, .yml, .json) instead"
    add("--opencv", type=Path, metavar="FILE", help=text)
    text = "stage heights of the views (default: the node's), or to verify at"
    add("--heights-mm", type=float, nargs="+", default=[], metavar="Z", help=text)
    text = "what to calibrate; one device alone: the other keeps its lens"
    add("--target", choices=["both", "camera", "projector"], default="both", help=text)
    text = "with --target: calibration whose other device is kept (default: the one in force)"
    add("--keep", type=Path, metavar="FILE", help=text)
    add("--sequence", default="", help="patterns, both axes (default: the node's)")
    text = "only check the calibration in force, on the plate or a flat (default: plate)"
    add("--verify", nargs="?", const="plate", choices=["plate", "flat"], help=text)
    add_waiting_arguments(parser, 600.0)
    add_graph_arguments(parser)


async def calibrate_bench(graph: Graph, options: GraphOptions) -> int:
    """Put the hole plate on the bench, calibrate, put the configured part back.

    Parameters
    ----------
    graph : Graph
        The running graph with its bench.
    options : GraphOptions
        Domain, namespace and configuration.
    """
    # Imported late: hardware does without it.
    from sl_bench.process.bench_control import BenchControl
    from sl_bench.process.bench_settings import read_settings

    config = options.directory / "config.yaml"
    part = read_settings(config)

    def put(surface: str, finish: str, parameters: Mapping[str, Any]) -> None:
        with BenchControl(options.directory) as bench:
            bench.put(surface, finish, **parameters)

    say("calibrating: the hole plate is on the stage")
    await asyncio.to_thread(put, "hole_plate", "matt", _plate_on_bench(config, options))
    words = ("--ros-args", *options.changes.ros_args)
    status = await graph.run_client(client_command(CLIENT, *words))
    await asyncio.to_thread(put, part.surface, part.finish, part.surface_parameters)
    say(f"the {part.surface} is on the stage again")
    return status


def _plate_on_bench(config: Path, options: GraphOptions) -> dict[str, Any]:
    """Parameters of the bench's hole plate, as the calibration's node believes it to be."""
    document = read_document(config, ConfigError)
    section = document.get(f"{options.changes.namespace}/calibration", {})
    parameters = section.get("ros__parameters", {})
    names = ("columns", "rows", "pitch_m", "diameter_m", "chamfer_m", "origin_diameter_m")
    found = {n: parameters[f"plate_{n}"] for n in names if f"plate_{n}" in parameters}
    mark = [f"plate_origin_{axis}" for axis in ("column", "row")]
    return found | ({"origin_id": [parameters[n] for n in mark]} if mark[0] in parameters else {})


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig calibrate``."""
    if args.source is not None:
        if args.opencv:
            return export(args.source, args.opencv)
        return solve_again(args.source, args.output)
    if args.opencv:
        raise ConfigError("--opencv writes a run's calibration; expected --from RUN beside it")
    options = graph_options(args)
    return run_client(CLIENT, args, options, options.directory / "graph.log")


def solve_again(source: Path, output: Path | None) -> int:
    """Solve a stored run, or the calibration in a recording, again; nothing is put in force.

    Parameters
    ----------
    source : Path
        Folder of a run, or a recording.
    output : Path or None
        Folder of the result; beside the source if None.
    """
    from sl_bringup.evaluation.calibrate_bag import solve_recorded
    from sl_calibration.data.run_store import OBSERVATIONS
    from sl_calibration.workflow.conclusion import solve_stored

    stored = source.suffix == ".npz" or (source / OBSERVATIONS).is_file()
    notes: list[str] = []
    if stored:
        run = source if source.is_dir() else source.with_suffix("")
        outcome = solve_stored(source, output or run / "again")
    else:
        name = source.name if source.is_dir() else source.stem
        folder = output or Path(f"{name}_calibration")
        outcome, notes = solve_recorded(source, folder, tell=complain)
    for line in [*outcome_lines(outcome), *notes]:
        say(line)
    return 0 if outcome.accepted else 1


def export(source: Path, file: Path) -> int:
    """Write a calibration (a file, or a run's) for OpenCV's tools.

    Parameters
    ----------
    source : Path
        Calibration file, or folder of a run.
    file : Path
        Written in the form of its suffix.
    """
    from sl_calibration.data.run_store import CALIBRATION
    from sl_calibration.report.opencv_export import opencv_values, save_opencv
    from sl_reconstruct.model.calibration_file import load_rig

    rig = load_rig(source / CALIBRATION if source.is_dir() else source)
    save_opencv(file, rig)
    values = opencv_values(rig)
    errors = (values[f"{name}_lens_error_px"] for name in ("cam", "proj"))
    camera, projector = (f"{error:.4f} px" for error in errors)
    say(f"{file}: OpenCV's lens is off the paper's by {camera} (camera), {projector} (projector)")
    return 0
