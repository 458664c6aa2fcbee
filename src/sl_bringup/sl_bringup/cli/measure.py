"""``slrig measure``: measurements of a cloud or height map, with uncertainty and verdict."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sl_bringup.graph.console import say
from sl_common.documents import written_atomically
from sl_common.errors import ConfigError, StackError
from sl_common.json_file import write_json
from sl_reconstruct.cloud.cloud_reader import read_cloud, read_height_map
from sl_reconstruct.cloud.height_map import make_height_map
from sl_reconstruct.cloud.x3p_writer import save_x3p
from sl_reconstruct.measure.deviation import DeviationMeasurement, map_reference, measure_deviation
from sl_reconstruct.measure.features import FEATURES, RECTANGLE, Numbers, Points
from sl_reconstruct.measure.plane_angle import PlaneMeasurement
from sl_reconstruct.measure.profile import ProfileMeasurement, save_profile
from sl_reconstruct.measure.region import Region
from sl_reconstruct.measure.result import Measurement, Tolerance, rounded
from sl_reconstruct.measure.roughness import RoughnessMeasurement

MILLIMETRE_M, MICROMETRE_M = 1e-3, 1e-6
#: Measurements shown in millimetres; other lengths are shown in micrometres.
IN_MILLIMETRES = ("sphere", "cylinder", "hole")


def numbers_of(text: str) -> Numbers:
    """Numbers separated by commas, millimetres, as metres.

    Examples
    --------
    >>> numbers_of("1,-2.5")
    (0.001, -0.0025)
    """
    try:
        return tuple(MILLIMETRE_M * float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected numbers like 0,0,2,1.5") from None


def tolerance_of(text: str) -> Tolerance:
    """``LOW:HIGH``, either may be left out."""
    low, colon, high = text.partition(":")
    try:
        limits = float(low or -math.inf), float(high or math.inf)
        if colon:
            return Tolerance(*limits)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text!r}; expected LOW:HIGH with LOW < HIGH")


def add_parser(subparsers: Any) -> None:
    """Register ``slrig measure``."""
    parser = subparsers.add_parser(
        "measure",
        description="Measure features of a cloud or height map, each with its standard "
        "uncertainty. Regions are in millimetres, as the axes of the pictures: X0,Y0,X1,Y1 or "
        "the corners of a polygon. Write --plane=-1,-1,1,1 where the first number is negative.",
        epilog="examples:\n"
        "  slrig measure output/groove/cloud.pcd --groove --tolerance 155.9:155.95\n"
        "  slrig measure cloud.pcd --angle=-2.5,-3,-0.5,3,0.5,-3,2.5,3 --json angle.json\n"
        "  slrig measure cloud.pcd --profile=-5,0,5,0,0.1 --csv section.csv\n"
        "exit status: 0 only when everything was measured and lies within its tolerance",
    )
    add = parser.add_argument
    text = "cloud.pcd, cloud.ply, or height.tiff with its report.json"
    add("cloud", type=Path, metavar="CLOUD|TIFF", help=text)
    for name, feature in FEATURES.items():
        if feature.metavar:
            add(f"--{name}", type=numbers_of, metavar=feature.metavar, help=feature.help)
        else:
            add(f"--{name}", action="store_const", const=(), help=feature.help)
    text = "compare with this height map (report.json beside it)"
    add("--reference", type=Path, metavar="TIFF", help=text)
    add("--level", action="store_true", help="take offset and tilt out of the comparison")
    text = "limits of the value, in its unit as printed; one measurement only"
    add("--tolerance", type=tolerance_of, metavar="LOW:HIGH", help=text)
    text = (
        "what the tolerance is for, as --json names it: Sa, centre_x, a, ... (default: the value); "
        "lengths in mm of sphere, cylinder and hole, else in µm"
    )
    add("--quantity", metavar="NAME", help=text)
    add("--region", type=numbers_of, metavar=RECTANGLE, help="where to compare (default: all over)")
    text = "draw the section with its uncertainty, or the map of deviations"
    add("--picture", type=Path, metavar="PNG", help=text)
    add("--json", type=Path, metavar="FILE", help="write all results")
    add("--csv", type=Path, metavar="FILE", help="write the section's points")
    add("--x3p", type=Path, metavar="FILE", help="write the height map as X3P")


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig measure``."""
    wanted = _wanted(args)
    if not wanted and args.x3p is None:
        raise ConfigError(f"nothing to measure; expected one of --{', --'.join(FEATURES)}, --x3p")
    if args.tolerance is not None and len(wanted) != 1:
        raise ConfigError(f"--tolerance with {len(wanted)} measurements; expected one")
    if args.quantity is not None and args.tolerance is None:
        raise ConfigError("--quantity says what a tolerance is for; expected --tolerance as well")
    if args.csv is not None and args.profile is None:
        raise ConfigError("--csv writes a section; expected --profile as well")
    if args.picture is not None and (args.profile is None) == (args.reference is None):
        raise ConfigError("--picture draws one thing; expected --profile or --reference as well")
    if args.region is not None and args.reference is None:
        raise ConfigError("--region says where to compare; expected --reference as well")
    points = read_cloud(args.cloud)
    verdicts, results = [], []
    for measure in wanted:
        found = measure(points)
        verdict = _verdict(found, args.tolerance, args.quantity)
        for line in lines(found):
            say(line)
        if verdict:
            say(f"{'tolerance':<18}{verdict}{f' ({args.quantity})' if args.quantity else ''}")
        verdicts.append(verdict)
        quantities = [quantity._asdict() for quantity in found.quantities()]
        plain = _plain(found.to_dict())
        results.append({**plain, "quantities": quantities, "verdict": verdict or None})
        if isinstance(found, ProfileMeasurement) and args.csv is not None:
            save_profile(args.csv, found)
        if args.picture is not None:
            _draw(args.picture, points, found, args.cloud.name)
    if args.x3p is not None:
        _write_x3p(args.x3p, points, args.cloud)
    if args.json is not None:
        write_json(args.json, {"format": 1, "cloud": str(args.cloud), "measurements": results})
    return 0 if all(verdict in ("", "pass") for verdict in verdicts) else 1


def _wanted(args: argparse.Namespace) -> list[Callable[[Points], Measurement]]:
    """What the options ask for, in the order of the table."""
    wanted: list[Callable[[Points], Measurement]] = []
    for name, feature in FEATURES.items():
        numbers = getattr(args, name.replace("-", "_"))
        if numbers is not None:
            wanted.append(lambda p, f=feature, n=numbers: f.measure(p, n))  # type: ignore[misc]
    if args.reference is not None:
        reference = map_reference(read_height_map(args.reference))
        region = Region.of(args.region) if args.region else None
        wanted.append(lambda p: measure_deviation(p, reference, region, args.level))
    return wanted


def _write_x3p(path: Path, points: Points, cloud: Path) -> None:
    """Write a height map that is as old as its cloud."""
    if points.ndim != 2:
        raise StackError("--x3p needs an organised cloud; expected cloud.pcd or height.tiff")
    save_x3p(path, make_height_map(points), datetime.fromtimestamp(cloud.stat().st_mtime, UTC))


def _draw(path: Path, points: Points, found: Measurement, title: str) -> None:
    """Draw a section or a map of deviations; of other measurements there is nothing to draw."""
    from sl_bringup.results.scan_pictures import residual_picture, section_picture  # half a second

    if isinstance(found, ProfileMeasurement):
        ends = " to ".join(f"({1e3 * x:g}, {1e3 * y:g})" for x, y in (found.from_m, found.to_m))
        png = section_picture([("mean of the strip", found)], f"{title}: section {ends} mm")
    elif isinstance(found, DeviationMeasurement):
        if points.ndim != 2:
            raise StackError("a map needs an organised cloud; expected cloud.pcd or height.tiff")
        off = points.copy()
        off["z"] = found.deviation_m
        height = make_height_map(off)
        png = residual_picture(height, height.z_m, f"{title}: deviation from the reference")
    else:
        return
    with written_atomically(path) as partial:
        partial.write_bytes(png)


def _shown_in(found: Measurement) -> tuple[float, str]:
    """Unit that a value is shown in: how many make one of its own, and its name."""
    if found.unit != "m":
        return 1.0, {"deg": "degrees"}.get(found.unit, "")
    if found.kind in IN_MILLIMETRES:
        return 1.0 / MILLIMETRE_M, "mm"
    return 1.0 / MICROMETRE_M, "µm"


def _verdict(found: Measurement, tolerance: Tolerance | None, name: str | None) -> str:
    """Verdict on one quantity, of which lengths are in the unit of the kind."""
    if tolerance is None:
        return ""
    judged = found.quantity(name)
    factor = _shown_in(found)[0] if judged.unit == "m" else 1.0
    return tolerance.verdict(factor * judged.value, factor * judged.uncertainty)


def lines(found: Measurement) -> Iterator[str]:
    """Lines that tell a person what was measured."""
    factor, unit = _shown_in(found)
    names = {"plane": "flatness", "deviation": "mean deviation", "roughness": "Sq",
             "angle": "included angle", "hole": "diameter", "profile": "height of section",
             "sphere": "radius", "cylinder": "radius", "step": "step height"}  # fmt: skip
    yield (
        f"{names[found.kind]:<18}{rounded(factor * found.value, factor * found.uncertainty)} "
        f"{unit} (standard uncertainty)"
    )
    aside = f", {found.set_aside:,} set aside" if found.set_aside else ""
    shared = (
        f", shared errors enlarge it {found.inflation:.2f} times" if found.inflation > 1 else ""
    )
    yield (
        f"{'  from':<18}{found.points:,} points{aside}, residuals "
        f"{found.rms_m / MICROMETRE_M:.4g} µm rms{shared}"
    )
    yield from _details(found)


def _details(found: Measurement) -> Iterator[str]:
    if isinstance(found, PlaneMeasurement):
        yield (
            f"{'  plane':<18}Z = {found.a:+.6f} X {found.b:+.6f} Y {1e3 * found.c_m:+.6f} mm, "
            f"uncertainties {found.u_a:.2g}, {found.u_b:.2g}, {1e3 * found.u_c_m:.2g} mm"
        )
    for name in ("first", "second"):
        plane = getattr(found, name, None)
        if plane is not None:
            yield from _details(plane)
    centre = getattr(found, "centre_m", None)
    if centre is not None:
        both = zip(centre, getattr(found, "u_centre_m", centre), strict=True)
        yield f"{'  centre':<18}({', '.join(rounded(1e3 * c, 1e3 * u) for c, u in both)}) mm"
    if isinstance(found, DeviationMeasurement):
        peak, valley = (f"{1e6 * v:+.4g} µm" for v in (found.peak_m, found.valley_m))
        yield (
            f"{'  form':<18}{1e6 * found.form_rms_m:.4g} µm rms beyond the stated noise; single "
            f"points {valley} to {peak}, noise and all"
        )
    if isinstance(found, RoughnessMeasurement):
        for name, value in found.corrected.items():
            length = name in ("Sa", "Sq", "Sp", "Sv", "Sz")
            factor, unit = (1e6, " µm") if length else (1.0, "")
            own, raw = factor * found.uncertainties[name], factor * found.raw[name]
            yield f"  {name:<16}{rounded(factor * value, own)}{unit} (with the noise {raw:.5g})"


def _plain(content: Mapping[str, Any]) -> dict[str, Any]:
    """Content without arrays of a cloud's size, for JSON."""
    return {key: value for key, value in content.items() if getattr(value, "ndim", 0) < 2}
