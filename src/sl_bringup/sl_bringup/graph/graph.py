"""A graph of this machine: its nodes and its bench as supervised processes."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from sl_bringup.graph.graph_config import (
    TRUE_RIG,
    Changes,
    find_config,
    runtime_directory,
    started_nodes,
    write_config,
)
from sl_bringup.graph.supervisor import Process, Supervisor
from sl_bringup.graph.transport import Transport, clean_stale_segments, process_environment
from sl_common.errors import ConfigError


@dataclass(frozen=True)
class GraphOptions:
    """What a graph is started with.

    Parameters
    ----------
    bench : bool
        On the simulated bench instead of hardware.
    config : Path or None
        Configuration file; None: the one that comes with the package.
    changes : Changes
        What this start changes about it.
    domain : int
        ROS domain.
    network : bool
        Open to other machines.
    """

    bench: bool = False
    config: Path | None = None
    changes: Changes = field(default_factory=Changes)
    domain: int = 0
    network: bool = False

    @property
    def source(self) -> Path:
        """The configuration file in use."""
        return self.config or find_config("bench.yaml" if self.bench else "hardware.yaml")

    @property
    def nodes(self) -> dict[str, str]:
        """Nodes of the graph and their modules."""
        return started_nodes(self.source)

    @property
    def directory(self) -> Path:
        """The graph's runtime directory."""
        return runtime_directory(self.domain)

    @property
    def transport(self) -> Transport:
        """How its processes talk."""
        return Transport(self.directory, self.domain, self.network)


def client_command(module: str, *arguments: str) -> tuple[str, ...]:
    """Command that runs a module of ours as a process.

    Parameters
    ----------
    module : str
        With a `main`.
    *arguments : str
        The module's own.
    """
    return (sys.executable, "-m", module, *arguments)


def client_environment(options: GraphOptions) -> dict[str, str]:
    """Environment of a ROS client of the graph."""
    return process_environment(options.transport.environment())


def readiness_command(options: GraphOptions, *arguments: str) -> tuple[str, ...]:
    """Command that asks whether a graph is ready.

    Parameters
    ----------
    options : GraphOptions
        Which graph.
    *arguments : str
        Further options of `ready_node`.
    """
    namespace = options.changes.namespace
    wanted = ("--namespace", namespace, "--nodes", *options.nodes, *arguments)
    return client_command("sl_bringup.ready_node", *wanted)


class Graph:
    """A running graph; an asynchronous context manager.

    Parameters
    ----------
    options : GraphOptions
        What it is started with.
    tell : callable
        Gets every line of its processes.
    """

    def __init__(self, options: GraphOptions, tell: Callable[[str], object]) -> None:
        self._options = options
        self._tell = tell
        self.supervisor = Supervisor(tell)
        self._bench_ready = asyncio.Event()
        self._bench_compiling = False
        self._lock: IO[str] | None = None
        self._client: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Graph:
        """Start all processes.

        Raises
        ------
        ConfigError
            When the configuration cannot be used, or a graph of this domain runs already.
        """
        self._lock = lock_directory(self._options.directory)
        try:
            clean_stale_segments()
            config = self._write_config()
            if self._options.bench:
                self._start_bench(config)
            for name, module in self._options.nodes.items():
                self._start_node(name, module, config)
        except BaseException:
            await self._stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop()

    async def ready(self, timeout_s: float) -> bool:
        """Wait until bench, nodes and services are up; each thing that is missing is reported.

        Parameters
        ----------
        timeout_s : float
            Give up when something has been missing for this long; 0: never. The time in which
            only the compiler is waited for does not count.
        """
        wanted = ("--timeout", f"{timeout_s}", "--wait-for-compiler")
        if await self.run_client(readiness_command(self._options, *wanted)):
            return False
        return not self._options.bench or await self._await_bench(timeout_s)

    async def _await_bench(self, timeout_s: float) -> bool:
        """Wait for the bench; while it compiles and does not die, for as long as it takes."""
        starts = self.supervisor.starts.get("bench")
        while True:
            try:
                await asyncio.wait_for(self._bench_ready.wait(), timeout_s or None)
                return True
            except TimeoutError:
                died = self.supervisor.starts.get("bench") != starts
                if died or not self._bench_compiling:
                    self._tell("graph not ready: the bench does not answer")
                    return False

    async def run_client(self, command: Sequence[str]) -> int:
        """Run a ROS client of this graph to its end, return its exit status."""
        self._client = await asyncio.create_subprocess_exec(
            *command,
            env=client_environment(self._options),
            stdin=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return await self._client.wait()
        finally:
            await self._end_client()

    async def _end_client(self) -> None:
        """Interrupt the client when the wait for it was given up."""
        client, self._client = self._client, None
        if client is None or client.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            client.terminate()
        try:
            await asyncio.wait_for(client.wait(), 5.0)
        except TimeoutError:
            client.kill()

    async def _stop(self) -> None:
        await self.supervisor.stop()
        if self._lock:
            self._lock.close()

    def _write_config(self) -> Path:
        config = write_config(self._options.source, self._options.directory, self._options.changes)
        if self._options.bench and not self._options.changes.uncalibrated:
            # Imported late: hardware does without it, and every process waits for this.
            from sl_bench.process.bench_settings import read_settings
            from sl_bench.world.true_rig import write_rig

            write_rig(self._options.directory / TRUE_RIG, read_settings(config).make_rig())
        return config

    def _start_bench(self, config: Path) -> None:
        places = ("--config", str(config), "--runtime-dir", str(self._options.directory))
        command = client_command("sl_bench.process.bench", *places)
        self.supervisor.start(Process("bench", command, process_environment({}), self._listen))

    def _listen(self, line: str) -> None:
        """Take from the bench's lines how far it is."""
        if line.strip() == "bench compiling":
            self._bench_compiling = True
        elif line.strip() == "bench ready":
            self._bench_ready.set()

    def _start_node(self, name: str, module: str, config: Path) -> None:
        ros_args = ("--ros-args", "--params-file", str(config), *self._options.changes.ros_args)
        environment = process_environment(self._options.transport.environment(name))
        self.supervisor.start(Process(name, client_command(module, *ros_args), environment))


def lock_directory(directory: Path) -> IO[str]:
    """Hold the directory for one graph; closing the file, or the end of the process, frees it.

    Raises
    ------
    ConfigError
        When another graph holds it.
    """
    file = (directory / "lock").open("a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        raise ConfigError(
            f"a graph runs already in this domain (process {holder}, {directory}); stop it, or "
            "choose another with --domain"
        ) from None
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return file


def is_running(directory: Path) -> bool:
    """Whether a supervised graph holds the directory."""
    try:
        lock_directory(directory).close()
    except ConfigError:
        return True
    return False
