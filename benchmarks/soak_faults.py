"""Scans with devices that fail at random over the live graph: no wrong cloud, dead node or leak.

Run as ``python benchmarks/soak_faults.py --scans 1000 --seed 1`` with the packages on the path. It
starts ``slrig up --bench`` (``--attach`` takes the graph that runs in the domain), makes one clean
scan per sequence, then scans while one device after the other fails: projector, camera, stage, each
in every way that the bench can do on request (``docs/faults.md``), at a random moment of the scan.

Held of every scan: it is answered, with a cloud or with a reason; every published cloud agrees with
the clean one; afterwards all nodes say on ``/diagnostics`` that they are well, with no more than
the services that an operator has; no process died. At the end no process has more threads or open
files than after the first scans. Memory is reported. The exit status is 0 when all that held.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sl_bench.process.bench_control import BenchControl
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.true_rig import write_rig
from sl_bringup.graph.graph import GraphOptions
from sl_bringup.graph.graph_config import find_config
from sl_bringup.graph.transport import process_environment
from sl_projector.sequence.pattern_sequence import named

NODES = ("projector", "camera", "stage", "synchronizer", "calibration", "reconstruct")
READY_S = 900.0
#: So long all nodes may take to be well again; longest is a projector that does not answer at all.
RECOVERY_S = 120.0
#: A scan that is not answered for so long is counted as silent.
ANSWER_S = 180.0
#: A cloud is wrong when more than this part of its points is further from the clean cloud than
#: 6 of the stated standard deviations of the difference and 2 um (white noise: 2e-9).
OUTLIER_PART, SIGMAS, SLACK_M = 1e-4, 6.0, 2e-6
#: A cloud is thin when it lacks more than this part of the clean cloud's points.
MISSING_PART = 0.02
#: So far from where it stood for the clean clouds the stage may stand, after what it suffered.
REPEATABILITY_M = 10e-6
#: Where the stage stands for a scan, metres.
HEIGHT_M = 0.0
#: Scans after which everything that is made once has been made.
WARM_SCANS = 20

Fault = tuple[str, dict[str, Any]]


# -- what goes wrong ----------------------------------------------------------------------------


def projector_fault(draw: random.Random, frames: int) -> Fault:
    """One of the faults of the DLPC900 and its cable."""
    some = draw.randint(1, 3)
    kinds: dict[str, dict[str, Any]] = {
        "refused command": {"refuse": some, "refuse_code": draw.choice([2, 5, 6, 8, 14, 255])},
        "lost reply": {"lose_replies": draw.randint(1, 2)},
        "late reply": {"late_replies": some, "late_s": draw.choice([0.05, 0.4, 2.2])},
        "stale reply": {"stale_replies": some},
        "short report": {"short_replies": draw.randint(1, 2)},
        "stall": {"stalls": some},
        "unplugged": {"unplug_s": draw.uniform(0.1, 1.5)},
        "power cycle": {"power_cycle": True},
        "kernel driver": {"kernel_driver": True, "unplug_s": 0.1},
        "taken": {"taken": True, "unplug_s": 0.1},
        "sequencer abort": {"abort_at": draw.randrange(frames)},
        "trigger lost": {"lost_edges": [draw.randrange(frames)]},
        "trigger doubled": {"doubled_edges": [draw.randrange(frames)]},
    }
    return draw.choice(list(kinds.items()))


def camera_fault(draw: random.Random, frames: int) -> Fault:
    """One of the faults of the camera and its cable."""
    kinds = ("drop", "duplicate", "swap", "delay", "stamp", "lost_trigger", "wrong_size",
             "saturate", "incomplete")  # fmt: skip
    kind = draw.choice([*kinds, "disconnected", "by chance"])
    if kind == "disconnected":
        return kind, {"disconnect_s": draw.uniform(0.1, 1.5)}
    if kind == "by chance":
        chance = {name: draw.choice([0.0, 0.03]) for name in kinds}
        return kind, {**chance, "seed": draw.randrange(1 << 30), "delay_s": draw.uniform(0.02, 3)}
    return kind, {
        "at": {kind: [draw.randrange(frames)]},
        "delay_s": draw.uniform(0.01, 4.0),
        "stamp_s": draw.choice([0.002, 0.01, 0.034]),
    }


def stage_fault(draw: random.Random, _frames: int) -> Fault:
    """One of the faults of the stage's controller and its cable."""
    kinds: dict[str, dict[str, Any]] = {
        "noise": {"noise": draw.randint(1, 60)},
        "lost reply": {"lose_replies": draw.randint(1, 3)},
        "late reply": {"delay_replies": [draw.randint(1, 3), draw.uniform(0.05, 4.0)]},
        "silent": {"fall_silent": True},
        "alarm": {"alarm": draw.randint(1, 9)},
        "limit switch": {"close_switch": draw.randrange(3)},
        "jam": {"jam": True},
        "power cycle": {"power_cycle": None},
        "unplugged": {"unplug_s": draw.uniform(0.1, 1.5)},
    }
    return draw.choice(list(kinds.items()))


FAULTS = {"projector": projector_fault, "camera": camera_fault, "stage": stage_fault}


@dataclass(frozen=True)
class Plan:
    """What happens to one scan; ``device`` empty: nothing does."""

    sequence: str
    repeats: int
    device: str = ""
    kind: str = "none"
    fault: dict[str, Any] = field(default_factory=dict)
    after_s: float = 0.0
    heal_after_s: float = 0.0
    move: bool = False

    @property
    def name(self) -> str:
        """Device and fault."""
        return f"{self.device}: {self.kind}" if self.device else "none"


def plan(draw: random.Random, frames: dict[str, int]) -> Plan:
    """Draw one scan."""
    sequence = draw.choices(list(frames), [4, 1][: len(frames)])[0]
    count = frames[sequence]
    repeats, after_s = draw.randrange(3), draw.uniform(-0.1, 0.034 * count + 0.2)
    heal_after_s = after_s + draw.uniform(0.2, 1.0)
    device = draw.choices(["", *FAULTS], [1, 4, 4, 3])[0]
    if not device:
        return Plan(sequence, repeats)
    kind, fault = FAULTS[device](draw, count)
    move = device == "stage" and draw.random() < 0.5
    # A scan that is repeated after the move would rightly show the part elsewhere.
    return Plan(sequence, 0 if move else repeats, device, kind, fault, after_s, heal_after_s, move)


# -- what is looked at --------------------------------------------------------------------------


def processes_of(domain_directory: Path) -> dict[str, int]:
    """Process ids of the graph in a runtime directory, by node; the bench among them."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if not any(word.startswith(str(domain_directory)) for word in words):
            continue
        for name in (*NODES, "bench"):
            if any(w.endswith((f".{name}_node", f"sl_bench.{name}")) for w in words):
                found[name] = int(entry.parent.name)
    return found


def resources_of(pid: int) -> dict[str, int]:
    """Threads, open files and resident memory (MB) of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    value = {line.split(":")[0]: line.split(":")[1].split() for line in status.splitlines()}
    return {
        "threads": int(value["Threads"][0]),
        "files": sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()),
        "memory": int(value["VmRSS"][0]) // 1024,
    }


class Client:
    """The robot cell: scans, hears the diagnostics, keeps the last cloud."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from sl_common import topics
        from sl_common.base_node import GraphNode

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = GraphNode("soak", namespace=topics.NAMESPACE)
        stage = (topics.MOVE_STAGE, topics.HOME_STAGE, topics.CLEAR_STAGE, topics.STOP_STAGE)
        self._clients = {s.name: self._node.client(s) for s in (topics.SCAN, *stage)}
        self.clouds: list[tuple[int, Any]] = []  # with the start of their first exposure, ns
        self.health: dict[str, tuple[float, int, str]] = {}
        self.exposing = threading.Event()
        self._node.listen(topics.TRIGGER, lambda _: self.exposing.set())
        self._node.listen(topics.POINTS, self._on_cloud)
        self._node.listen(topics.DIAGNOSTICS, self._on_health)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """Leave the graph."""
        import rclpy

        self._executor.shutdown()
        rclpy.try_shutdown()
        self._thread.join(10.0)
        self._node.destroy_node()

    def _on_cloud(self, message: Any) -> None:
        from sl_reconstruct.messages import cloud_from_msg

        stamp = message.header.stamp
        self.clouds.append((stamp.sec * 10**9 + stamp.nanosec, cloud_from_msg(message).copy()))

    def _on_health(self, message: Any) -> None:
        for status in message.status:
            level = int.from_bytes(status.level, "little")
            if any(item.key == "passing" for item in status.values):
                level = 0  # well, but something was refused a moment ago
            name = status.name.split(":")[0]
            self.health[name] = (time.monotonic(), level, status.message)

    def ask(self, name: str, timeout_s: float = 60.0, **fields: Any) -> Any:
        """Call a service; None when it does not answer."""
        client = self._clients[name]
        if not client.wait_for_service(30.0):
            return None
        request = client.srv_type.Request()
        for key, value in fields.items():
            setattr(request, key, value)
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        return future.result() if done.wait(timeout_s) else None

    def move(self, z_m: float) -> Any:
        """Move the stage."""
        from geometry_msgs.msg import Point

        return self.ask("stage/move", target=Point(z=z_m))

    def ill(self, since_s: float) -> dict[str, str]:
        """Nodes that are not well, or have not said so since; and what they say."""
        found = {}
        for name in NODES:
            when_s, level, message = self.health.get(name, (0.0, 9, "silent"))
            if level or when_s <= since_s:
                found[name] = message if level else "silent since the scan"
        return found


def wrong(cloud: Any, clean: Any, offset_m: float) -> str:
    """What is wrong with a cloud of a part that stands a little elsewhere; empty: nothing."""
    here, there = np.isfinite(cloud["z"]), np.isfinite(clean["z"])
    both = here & there
    variance = cloud["sigma"].astype(float) ** 2 + clean["sigma"].astype(float) ** 2
    limit_m = SIGMAS * np.sqrt(variance[both]) + SLACK_M + 2.0 * offset_m
    far = int((np.abs(cloud["z"][both] - clean["z"][both]) > limit_m).sum())
    if far > OUTLIER_PART * both.sum():
        return f"{far} of {both.sum()} points are elsewhere"
    return ""


def thin(cloud: Any, clean: Any) -> bool:
    """Whether points are missing: refused one by one where a saturated frame left no doubt."""
    here, there = (int(np.isfinite(c["z"]).sum()) for c in (cloud, clean))
    return here < (1 - MISSING_PART) * there


# -- the soak -----------------------------------------------------------------------------------


class Soak:
    """Runs plans against a graph and keeps the books."""

    def __init__(
        self, client: Client, control: BenchControl, directory: Path, keep: Path | None
    ) -> None:
        self._client, self._control, self._directory = client, control, directory
        self._keep = keep
        self._clean: dict[str, Any] = {}
        self.frames: dict[str, int] = {}
        self.pids = processes_of(directory)
        self.books: dict[str, Counter[str]] = defaultdict(Counter)
        self.recoveries_s: dict[str, list[float]] = defaultdict(list)
        self.samples: dict[str, list[dict[str, int]]] = defaultdict(list)
        self.defects: list[str] = []
        self.spent_s: Counter[str] = Counter()
        # Of a scan that is repeated because the projector failed at its end, two clouds may come.
        self._sequences: list[tuple[int, str]] = []
        self.reasons: Counter[str] = Counter()

    def learn(self, sequences: list[str]) -> None:
        """Make the clean clouds, where the stage is brought back to after each of its faults."""
        moved = self._client.move(HEIGHT_M)
        if moved is None or not moved.success:
            raise SystemExit(f"the stage does not move: {moved and moved.message}")
        self._origin_m = self._stage_m()
        for sequence in sequences:
            answer = self._client.ask("scan", ANSWER_S, sequence=sequence, max_repeats=30)
            if answer is None or not answer.success:
                raise SystemExit(f"no clean scan of {sequence}: {answer and answer.message}")
            self._await_clouds(1)
            self._clean[sequence] = self._client.clouds.pop()[1]
            self.frames[sequence] = len(named(sequence))

    def _stage_m(self) -> list[float]:
        return list(self._control.state()["stage_m"])

    def _await_clouds(self, count: int) -> None:
        end_s = time.monotonic() + 10.0
        while len(self._client.clouds) < count and time.monotonic() < end_s:
            time.sleep(0.01)

    def run(self, index: int, what: Plan) -> None:
        """Make one scan, see what came of it, heal."""
        self._client.exposing.clear()
        began_s = time.monotonic()
        self._sequences.append((time.time_ns(), what.sequence))
        offset_m = max(abs(a - b) for a, b in zip(self._stage_m(), self._origin_m, strict=True))
        threads = [threading.Thread(target=self._sabotage, args=(what, time.monotonic()))]
        if what.move:
            threads.append(threading.Thread(target=self._move, args=(what,)))
        for thread in threads:
            thread.start()
        answer = self._client.ask(
            "scan", ANSWER_S, sequence=what.sequence, max_repeats=what.repeats
        )
        answered_s = time.monotonic()
        for thread in threads:
            thread.join()
        self._judge(index, what, answer, offset_m)
        healed_s = time.monotonic()
        self._heal(index, what)
        well_s = time.monotonic()
        self.recoveries_s[what.name].append(well_s - healed_s)
        self._sample(index)
        self.spent_s["scan"] += answered_s - began_s
        self.spent_s["recover"] += well_s - healed_s
        self.spent_s["else"] += time.monotonic() - well_s + healed_s - answered_s

    def _sabotage(self, what: Plan, began_s: float) -> None:
        if not what.device:
            return
        if what.after_s > 0:
            time.sleep(what.after_s)
        self._control.fault(what.device, **what.fault)
        # What lasts until somebody repairs it (a jam, another program) is repaired after a while.
        time.sleep(max(0.0, began_s + what.heal_after_s - time.monotonic()))
        if what.kind in ("silent", "jam", "taken", "limit switch"):
            self._control.clear_faults()

    def _move(self, what: Plan) -> None:
        """Move while patterns are shown; before them the part would rightly show elsewhere."""
        if self._client.exposing.wait(10.0):
            time.sleep(max(0.0, what.after_s - 0.05))
            self._client.move(0.5e-3)

    def _judge(self, index: int, what: Plan, answer: Any, offset_m: float) -> None:
        book = self.books[what.name]
        book["scans"] += 1
        if answer is None:
            self._defect(index, what, "the scan was not answered")
            return
        if answer.success:
            book["repeated" if answer.report.attempts > 1 else "at once"] += 1
            self._await_clouds(1)
            if not self._client.clouds:
                self._defect(index, what, "a cloud was promised and did not come")
        else:
            book["refused"] += 1
            self.reasons[_words(answer.message)] += 1
            if not answer.message:
                self._defect(index, what, "refused without a reason")
        # Carriages stop between two steps when power fails: they come back to within a few.
        if offset_m > REPEATABILITY_M:
            self._defect(index, what, f"the stage stood {offset_m * 1e6:.0f} um off")
        clouds, self._client.clouds[:] = list(self._client.clouds), []
        for stamp_ns, cloud in clouds:
            sequence = next(s for began_ns, s in reversed(self._sequences) if began_ns <= stamp_ns)
            book["thin"] += thin(cloud, self._clean[sequence])
            if fault := wrong(cloud, self._clean[sequence], offset_m):
                self._defect(index, what, f"WRONG CLOUD: {fault} ({offset_m * 1e6:.1f} um off)")
                if self._keep:
                    file = self._keep / f"wrong_{index}.npz"
                    np.savez(file, cloud=cloud, clean=self._clean[sequence])

    def _defect(self, index: int, what: Plan, text: str) -> None:
        self.books[what.name]["defects"] += 1
        self.defects.append(f"scan {index} ({what.name} {what.fault}): {text}")
        print(self.defects[-1], flush=True)

    def _heal(self, index: int, what: Plan) -> None:
        """Take the causes away; then do what an operator would, until all nodes are well."""
        self._control.clear_faults()
        since_s = end_s = time.monotonic()
        end_s += RECOVERY_S
        while ill := self._client.ill(since_s):
            if time.monotonic() > end_s:
                self._defect(index, what, f"not well after {RECOVERY_S:g} s: {ill}")
                break
            if "stage" in ill and not ill["stage"].startswith("silent since"):
                self._operate(ill["stage"])
            time.sleep(0.05)
        if what.device == "stage":
            self._bring_home(index, what)

    def _operate(self, message: str) -> None:
        if message.startswith("alarm"):
            self._client.ask("stage/clear")
        elif message.startswith("not_homed"):
            self._client.ask("stage/home", 120.0)
        elif message.startswith("hold"):
            self._client.ask("stage/stop")
        else:
            return
        self._client.health.pop("stage", None)

    def _bring_home(self, index: int, what: Plan) -> None:
        if what.kind in ("alarm", "limit switch", "power cycle"):
            self._client.ask("stage/home", 120.0)
        answer = self._client.move(HEIGHT_M)
        if answer is None or not answer.success:
            self._defect(index, what, f"no move afterwards: {answer and answer.message}")

    def _sample(self, index: int) -> None:
        alive = processes_of(self._directory)
        for name, pid in self.pids.items():
            if alive.get(name) != pid:
                self.books["-"]["deaths"] += 1
                self.defects.append(f"scan {index}: {name} is not process {pid} any more")
        self.pids = alive
        for name, pid in alive.items():
            self.samples[name].append(resources_of(pid))

    def leaks(self) -> list[str]:
        """Processes that hold more threads or files at the end than after the first scans."""
        found = []
        for name, samples in self.samples.items():
            part = max(5, len(samples) // 10)
            first, last = samples[WARM_SCANS:][:part], samples[-part:]
            for what, slack in (("threads", 0), ("files", 1)):
                if not first:
                    continue
                before, after = (statistics.median(s[what] for s in x) for x in (first, last))
                if after > before + slack:
                    found.append(f"{name}: {before:g} {what} became {after:g}")
        return found

    def report(self) -> dict[str, Any]:
        """All figures."""
        return {
            "scans": sum(book["scans"] for book in self.books.values()),
            "totals": dict(sum(self.books.values(), Counter())),
            "defects": self.defects,
            "leaks": self.leaks(),
            "faults": {
                name: {
                    **book,
                    "recovery_median_s": round(statistics.median(self.recoveries_s[name]), 2),
                    "recovery_max_s": round(max(self.recoveries_s[name]), 2),
                }
                for name, book in sorted(self.books.items())
                if self.recoveries_s[name]
            },
            "resources": {name: _course(samples) for name, samples in self.samples.items()},
            "reasons": dict(self.reasons.most_common()),
        }


def _words(message: str) -> str:
    """A reason without its numbers, to be counted."""
    return "".join("#" if c.isdigit() else c for c in message)[:110]


def _course(samples: list[dict[str, int]]) -> dict[str, list[int]]:
    """First sample after the warm-up, maximum, last."""
    warm = samples[WARM_SCANS:] or samples
    return {k: [warm[0][k], max(s[k] for s in warm), warm[-1][k]] for k in warm[0]}


# -- the graph ----------------------------------------------------------------------------------


def write_config(options: GraphOptions, rows: int) -> Path:
    """Write a configuration of the bench whose camera has only some rows, about its middle."""
    rig = reference_rig()
    (width, height), (u, v) = rig.camera.image_size, rig.camera.image_centre_px
    camera = replace(
        rig.camera, image_size=(width, rows), image_centre_px=(u, v - (height - rows) // 2)
    )
    write_rig(options.directory / "soak_rig.yaml", replace(rig, camera=camera))
    document = yaml.safe_load(find_config("bench.yaml").read_text())
    bench = document["/sl/bench"]["ros__parameters"]
    bench |= {"rig": str(options.directory / "soak_rig.yaml"), "niceness": 0}
    file = options.directory / "soak.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def start_graph(options: GraphOptions, log: Path) -> subprocess.Popen[bytes]:
    """Start ``slrig up`` and wait until it is ready."""
    command = [sys.executable, "-m", "sl_bringup.cli.main", "up", "--bench"]
    command += ["--domain", str(options.domain)]
    command += ["--config", str(options.config)] if options.config else []
    environment = process_environment({"PYTHONPATH": os.pathsep.join(sys.path)})
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, env=environment)
    end_s = time.monotonic() + READY_S
    while "graph ready" not in log.read_text(errors="replace"):
        if process.poll() is not None or time.monotonic() > end_s:
            process.terminate()
            raise SystemExit(f"the graph did not start; see {log}")
        time.sleep(0.1)
    return process


def soak(arguments: argparse.Namespace, options: GraphOptions) -> dict[str, Any]:
    """Make all scans and return the figures."""
    os.environ.update(options.transport.environment())
    draw = random.Random(arguments.seed)
    began_s = time.monotonic()
    with BenchControl(options.directory) as control, contextlib.closing(Client()) as client:
        run = Soak(client, control, options.directory, arguments.keep)
        run.learn(arguments.sequences.split(","))
        ended = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: ended.set())  # the figures so far are told
        for index in range(arguments.scans):
            what = plan(draw, run.frames)
            if arguments.verbose:
                print(index, asdict(what), flush=True)
            run.run(index, what)
            if index % 25 == 24:
                lasted_s = time.monotonic() - began_s
                totals = dict(sum(run.books.values(), Counter()))
                spent = {name: round(seconds) for name, seconds in run.spent_s.items()}
                print(f"{index + 1} scans, {lasted_s:.0f} s {spent}: {totals}", flush=True)
            if ended.is_set():
                break
        return {**run.report(), "seed": arguments.seed, "lasted_s": time.monotonic() - began_s}


def main(make: Callable[..., dict[str, Any]] = soak) -> int:
    """Read the command line, soak, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--sequences", default="paper,precise")
    parser.add_argument(
        "--rows", type=int, default=200, help="camera rows, of 1200; less is faster"
    )
    parser.add_argument("--attach", action="store_true", help="use the graph that runs")
    parser.add_argument("--log", type=Path, default=Path("soak_graph.log"))
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--keep", type=Path, help="folder for wrong clouds")
    parser.add_argument("--verbose", action="store_true", help="tell each plan")
    arguments = parser.parse_args()
    options = GraphOptions(bench=True, domain=arguments.domain)
    if not arguments.attach:
        options = replace(options, config=write_config(options, arguments.rows))
    graph = None if arguments.attach else start_graph(options, arguments.log)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        figures = make(arguments, options)
    finally:
        if graph is not None:
            graph.send_signal(signal.SIGINT)
            graph.wait(60)
    if graph is not None and graph.returncode:
        figures["defects"].append(f"the graph ended with status {graph.returncode}")
    text = json.dumps(figures, indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text)
    return 1 if figures["defects"] or figures["leaks"] else 0


if __name__ == "__main__":
    sys.exit(main())
