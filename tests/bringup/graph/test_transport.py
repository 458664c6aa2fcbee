"""Profiles, shared memory and environment; what Fast DDS makes of them is for the graph's tests."""

from __future__ import annotations

import fcntl
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from sl_bringup.graph.transport import (
    MIB,
    SEGMENT_BYTES,
    SMALL_SEGMENT_BYTES,
    Transport,
    clean_stale_segments,
    profile_xml,
    segment_bytes,
)
from sl_common.errors import ConfigError

NAMES = {"d": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}


def value(xml: str, tag: str) -> str | None:
    return ElementTree.fromstring(xml).findtext(f".//d:{tag}", namespaces=NAMES)


@pytest.mark.parametrize("segment", [2 * MIB, 4 * MIB, 32 * MIB, 96 * MIB])
def test_a_piece_never_exceeds_the_segment(segment: int) -> None:
    """Otherwise Fast DDS leaves shared memory out without an error."""
    xml = profile_xml(segment, network=False)
    assert int(value(xml, "segment_size") or 0) == segment
    assert 0 < int(value(xml, "maxMessageSize") or 0) <= segment


def test_sockets_are_bound_to_loopback_unless_opened_on_purpose() -> None:
    assert value(profile_xml(4 * MIB, network=False), "address") == "127.0.0.1"
    assert value(profile_xml(4 * MIB, network=True), "address") is None


def test_segments_hold_what_the_nodes_publish() -> None:
    frame = 1600 * 1200
    assert SEGMENT_BYTES["camera"] >= 11 * frame  # a whole sequence of the paper
    assert SEGMENT_BYTES["synchronizer"] >= 25 * frame  # a stack of `precise`
    assert SEGMENT_BYTES["reconstruct"] >= 1200 * 1023 * 20  # a full organised cloud


def test_little_shared_memory_is_divided_and_none_is_left_alone() -> None:
    plenty = 8 << 30
    assert segment_bytes("camera", plenty) == SEGMENT_BYTES["camera"]
    assert segment_bytes("stage", plenty) == SMALL_SEGMENT_BYTES
    docker = 64 * MIB
    shares = [segment_bytes(n, docker) for n in (*SEGMENT_BYTES, *["small"] * 4)]
    assert 0 < sum(shares) <= docker
    assert segment_bytes("camera", 0) == 0


def test_environment_of_a_process(tmp_path: Path) -> None:
    found = Transport(tmp_path, domain=7).environment("camera")
    assert found["ROS_DOMAIN_ID"] == "7"
    assert found["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"
    assert int(found["MALLOC_MMAP_THRESHOLD_"]) > 50e6  # a stack stays in the heap
    assert Path(found["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()


@pytest.mark.parametrize("domain", [-1, 102, 233])
def test_a_domain_outside_the_ports_is_refused(tmp_path: Path, domain: int) -> None:
    with pytest.raises(ConfigError, match="0 to 101"):
        Transport(tmp_path, domain)


def test_only_segments_of_dead_processes_are_removed(tmp_path: Path) -> None:
    def segment(name: str, age_s: float) -> Path:
        lock = tmp_path / f"fastrtps_{name}_el"
        lock.touch()
        (tmp_path / f"fastrtps_{name}").write_bytes(bytes(1000))
        then_s = lock.stat().st_mtime - age_s
        os.utime(lock, (then_s, then_s))
        return lock

    dead, alive, young = (segment(c * 16, age) for c, age in (("a", 60), ("b", 60), ("c", 0)))
    other = tmp_path / "somebody_else"
    other.touch()
    with alive.open() as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        assert clean_stale_segments(tmp_path) == 1000
    left = {path.name for path in tmp_path.iterdir()}
    assert dead.name not in left
    assert {alive.name, young.name, other.name, f"fastrtps_{'b' * 16}"} <= left
