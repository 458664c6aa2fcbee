"""How the processes of the graph talk: Fast DDS profile, allocator, discovery; no ROS in here.

With its defaults Fast DDS loses or delays images of this size and stalls the triggers published
beside them (``docs/transport.md``). `environment` is what every process of the graph, of a scan
and of a test is started with; it must be set before the process starts, since the allocator and
Fast DDS read it only once.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sl_common.documents import write_text
from sl_common.errors import ConfigError

MIB = 1 << 20
SHM_DIRECTORY = Path("/dev/shm")
MAX_DOMAIN = 101

#: Shared memory of a node that publishes large messages, bytes; all of it is taken at once.
#: The camera's holds 17 frames of 1600 x 1200, the others one message of `precise`; a larger one
#: passes in turns.
SEGMENT_BYTES = {"camera": 32 * MIB, "synchronizer": 64 * MIB, "reconstruct": 32 * MIB}
#: Of all others, which publish small messages only.
SMALL_SEGMENT_BYTES = 4 * MIB
#: A message above is sent in pieces. At this size sender and receiver overlap: a stack of 48 MB
#: takes 40 ms instead of 70 in pieces of 16 MB, and small segments do (``docs/transport.md``).
#: It must not exceed the segment, else Fast DDS drops the shared memory without a word.
MAX_PIECE_BYTES = MIB
#: Less than this cannot carry frames; the shared memory is then left to Fast DDS' defaults.
LEAST_SEGMENT_BYTES = 2 * MIB

#: glibc returns large blocks to the system at once and clears them again at the next message;
#: kept, receiving costs half. Kept in one arena for all threads, and not beyond 64 MB at its end,
#: else the reconstruction holds 70 MB more.
ALLOCATOR = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": str(1024 * MIB),
    "MALLOC_TRIM_THRESHOLD_": str(64 * MIB),
    "MALLOC_TOP_PAD_": str(4 * MIB),
}

#: Time between two announcements of a process, not 3 s: a newcomer that missed the first
#: announcements, as on a busy machine it does, would wait for the next (``docs/transport.md``).
ANNOUNCEMENT_S = 1

_PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>sl_shm</transport_id><type>SHM</type>
      <segment_size>{segment}</segment_size><maxMessageSize>{piece}</maxMessageSize>
      <port_queue_capacity>1024</port_queue_capacity>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>sl_udp</transport_id><type>UDPv4</type>{whitelist}
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="sl" is_default_profile="true"><rtps>
    <userTransports>
      <transport_id>sl_shm</transport_id><transport_id>sl_udp</transport_id>
    </userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
    <builtin><discovery_config>
      <leaseAnnouncement><sec>{announcement}</sec></leaseAnnouncement>
    </discovery_config></builtin>
  </rtps></participant>
</profiles></dds>
"""
_LOOPBACK = "\n      <interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>"


@dataclass(frozen=True)
class Transport:
    """Where a graph lives and who may reach it.

    Parameters
    ----------
    directory : Path
        The profiles are written here.
    domain : int
        ROS domain, 0 to 101 (above, its ports fall into the range of passing connections).
    network : bool
        Open to other machines. Otherwise all sockets are bound to loopback.

    Raises
    ------
    ConfigError
        When the domain is out of range.
    """

    directory: Path
    domain: int = 0
    network: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= MAX_DOMAIN:
            raise ConfigError(f"domain={self.domain}; expected 0 to {MAX_DOMAIN}")

    def environment(self, name: str = "") -> dict[str, str]:
        """Variables of the process of node ``name``, to be added to its environment.

        Writes the process's profile; a name without an entry in `SEGMENT_BYTES` publishes small
        messages only.
        """
        segment = segment_bytes(name, free_bytes())
        variables = {
            **ALLOCATOR,
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET" if self.network else "SYSTEM_DEFAULT",
            "PYTHONUNBUFFERED": "1",
            "RCUTILS_LOGGING_USE_STDOUT": "1",
        }
        if segment:
            file = self.directory / f"fastdds-{segment // MIB}.xml"
            write_text(file, profile_xml(segment, self.network))
            variables["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(file)
        return variables


def profile_xml(segment: int, network: bool) -> str:
    """Fast DDS profile of a process.

    Parameters
    ----------
    segment : int
        Shared memory, bytes.
    network : bool
        Open to other machines; otherwise loopback.
    """
    return _PROFILE.format(
        segment=segment,
        piece=min(MAX_PIECE_BYTES, segment // 2),
        announcement=ANNOUNCEMENT_S,
        whitelist="" if network else _LOOPBACK,
    )


def segment_bytes(name: str, free: int) -> int:
    """Shared memory of a process, bytes; scaled down to half of what is free, 0 when too little.

    Containers have 64 MB by default; pieces of a message wait for each other there.

    Parameters
    ----------
    name : str
        The process, as in the configuration.
    free : int
        Free shared memory, bytes.
    """
    wanted = SEGMENT_BYTES.get(name, SMALL_SEGMENT_BYTES)
    whole = sum(SEGMENT_BYTES.values()) + 4 * SMALL_SEGMENT_BYTES
    scaled = min(wanted, wanted * (free // 2) // whole) // MIB * MIB
    return scaled if scaled >= min(wanted, LEAST_SEGMENT_BYTES) else 0


def free_bytes(directory: Path = SHM_DIRECTORY) -> int:
    """Free shared memory, bytes; 0 where there is none."""
    try:
        return shutil.disk_usage(directory).free
    except OSError:
        return 0


def clean_stale_segments(directory: Path = SHM_DIRECTORY, min_age_s: float = 10.0) -> int:
    """Remove segments of processes that were killed, return the number of bytes given back.

    As ``fastdds shm clean``: a process that lives holds a lock on its segment's lock file. Files
    younger than ``min_age_s`` are left alone: their owner may be about to lock them.

    Parameters
    ----------
    directory : Path
        Where shared memory is.
    min_age_s : float
        Age from which a file may go, seconds.
    """
    freed = 0
    for lock in directory.glob("fastrtps_" + "[0-9a-z]" * 16 + "_el"):
        with contextlib.suppress(OSError):
            if time.time() - lock.stat().st_mtime >= min_age_s:
                freed += _remove_if_unlocked(lock)
    return freed


def _remove_if_unlocked(lock: Path) -> int:
    segment = lock.with_name(lock.name.removesuffix("_el"))
    with lock.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        size = segment.stat().st_size if segment.exists() else 0
        segment.unlink(missing_ok=True)
        lock.unlink(missing_ok=True)
    return size


def process_environment(additions: Mapping[str, str]) -> dict[str, str]:
    """Environment of this process with additions, fit for a child Python.

    The wheels' start-up marks an interpreter that has its libraries by a variable that leaks to
    children; a child of another venv would then lack them.
    """
    inherited = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return {**inherited, **additions}
