"""Recordings as they grow: what foreign readers see, what a killed recorder leaves."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from sl_bringup.bag.bag_recorder import BagRecorder
from sl_bringup.bag.bag_writer import topic_qos
from sl_bringup.bag.bags import make_message, open_bag, typestore
from sl_bringup.cli.main import main
from sl_bringup.cli.record import size_bytes
from sl_bringup.graph.console import StatusLine
from sl_common.errors import BagError, ConfigError
from sl_common.messages import header
from sl_common.topics import CALIBRATION, IMAGE, POSE, SETTINGS, TRIGGER
from sl_projector.sequence.pattern_sequence import named

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
COUNT = 12
#: Larger than a chunk of small messages: each image is a chunk of its own.
SHAPE = (300, 400)


def image(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 256, SHAPE, np.uint8)


def image_cdr(i: int) -> bytes:
    message = make_message(
        IMAGE.msgtype, header=header(START_NS + i * STEP_NS, "c", make_message),
        height=SHAPE[0], width=SHAPE[1], encoding="mono8", is_bigendian=0, step=SHAPE[1],
        data=image(i).reshape(-1),
    )  # fmt: skip
    return bytes(typestore().serialize_cdr(message, IMAGE.msgtype))


def settings_cdr(text: str) -> bytes:
    message = make_message(SETTINGS.msgtype, data=text)
    return bytes(typestore().serialize_cdr(message, SETTINGS.msgtype))


def record(path: Path, split_bytes: int = 0, compress: bool = False) -> list[int]:
    """Twelve images after one latched text; sizes of the file after each image."""
    sizes = []
    with BagRecorder(path, {"software": "test"}, split_bytes, compress) as bag:
        for topic in (SETTINGS, IMAGE):
            bag.add_topic(f"/sl/{topic.name}", topic.msgtype, topic_qos(topic))
        bag.write("/sl/reconstruct/settings", START_NS, START_NS, settings_cdr("{}"))
        for i in range(COUNT):
            stamp_ns = START_NS + (i + 1) * STEP_NS
            bag.write("/sl/camera/image_raw", stamp_ns, stamp_ns - 1, image_cdr(i))
            sizes.append(bag.size)
    return sizes


def images_in(path: Path) -> tuple[list[int], list[str]]:
    """Numbers of the images that are there, each compared pixel by pixel; and what is lost."""
    with open_bag(path) as bag:
        found = list(bag.messages(IMAGE))
        numbers = [(m.received_ns - START_NS) // STEP_NS - 1 for m in found]
        for number, recorded in zip(numbers, found, strict=True):
            assert np.array_equal(recorded.message.data.reshape(SHAPE), image(number))
        return numbers, bag.lost


@pytest.mark.parametrize("compress", [False, True])
def test_foreign_readers_read_it(tmp_path: Path, compress: bool) -> None:
    record(tmp_path / "a", compress=compress)
    with AnyReader([tmp_path / "a"]) as reader:
        assert reader.message_count == COUNT + 1
        for i, (connection, stamp_ns, data) in enumerate(
            reader.messages([c for c in reader.connections if c.topic == "/sl/camera/image_raw"])
        ):
            message = reader.deserialize(data, connection.msgtype)
            assert stamp_ns == START_NS + (i + 1) * STEP_NS
            assert np.array_equal(message.data.reshape(SHAPE), image(i))
    with (tmp_path / "a" / "a_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == COUNT + 1
        assert {c.topic for c in summary.channels.values()} == {
            "/sl/camera/image_raw", "/sl/reconstruct/settings"
        }  # fmt: skip
        found = list(reader.iter_messages(topics=["/sl/camera/image_raw"]))
        assert [m.data for _, _, m in found] == [image_cdr(i) for i in range(COUNT)]
        assert [m.publish_time for _, _, m in found] == [m.log_time - 1 for _, _, m in found]
        assert next(iter(reader.iter_metadata())).metadata == {"software": "test"}


def test_the_metadata_is_what_rosbag2_asks_for(tmp_path: Path) -> None:
    """Keys of rosbag2_storage's yaml.hpp, version 9."""
    record(tmp_path / "a")
    text = (tmp_path / "a" / "metadata.yaml").read_text()
    found = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert {key: found[key] for key in (
        "version", "storage_identifier", "message_count", "relative_file_paths", "duration",
        "starting_time", "compression_format", "compression_mode", "custom_data",
    )} == {
        "version": 9, "storage_identifier": "mcap", "message_count": COUNT + 1,
        "relative_file_paths": ["a_0.mcap"], "duration": {"nanoseconds": COUNT * STEP_NS},
        "starting_time": {"nanoseconds_since_epoch": START_NS}, "compression_format": "",
        "compression_mode": "", "custom_data": {"software": "test"},
    }  # fmt: skip
    topics = {t["topic_metadata"]["name"]: t for t in found["topics_with_message_count"]}
    qos = topics["/sl/reconstruct/settings"]["topic_metadata"]["offered_qos_profiles"][0]
    assert qos["durability"] == "transient_local"
    assert set(qos) == {
        "history", "depth", "reliability", "durability", "deadline", "lifespan", "liveliness",
        "liveliness_lease_duration", "avoid_ros_namespace_conventions",
    }  # fmt: skip
    assert topics["/sl/camera/image_raw"]["message_count"] == COUNT


def test_each_part_of_a_split_bag_can_be_used_alone(tmp_path: Path) -> None:
    record(tmp_path / "a", split_bytes=4 * SHAPE[0] * SHAPE[1])
    files = sorted((tmp_path / "a").glob("*.mcap"))
    assert len(files) == 3
    assert images_in(tmp_path / "a") == (list(range(COUNT)), [])
    parts = []
    for file in files:
        numbers, lost = images_in(file)
        assert not lost
        parts += numbers
        with open_bag(file) as bag:
            assert [m.message.data for m in bag.messages(SETTINGS)] == ["{}"]
    assert parts == list(range(COUNT))


def test_cut_anywhere_all_whole_images_are_read(tmp_path: Path) -> None:
    ends = record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    (tmp_path / "a" / "metadata.yaml").unlink()
    content = file.read_bytes()
    for cut in (ends[-1], ends[5], ends[5] - 1, ends[5] + 30, ends[5] + 5000, ends[0], 200, 60):
        file.write_bytes(content[:cut])
        numbers, lost = images_in(tmp_path / "a")
        # an image is whole when its chunk is; the chunk's index, after it, may be missing
        index_bytes = 9 + 2 + 4 + 16
        assert numbers == [i for i, end in enumerate(ends) if end - index_bytes <= cut]
        assert [line for line in lost if f"of {cut} bytes" in line]


def test_metadata_are_there_before_the_end(tmp_path: Path) -> None:
    """What a killed recorder leaves names its files and topics, and is read without a complaint."""
    size = SHAPE[0] * SHAPE[1]
    with BagRecorder(tmp_path / "a", split_bytes=4 * size) as bag:
        for topic in (SETTINGS, IMAGE):
            bag.add_topic(f"/sl/{topic.name}", topic.msgtype, topic_qos(topic))
        bag.tick()
        for i in range(5):
            stamp_ns = START_NS + (i + 1) * STEP_NS
            bag.write("/sl/camera/image_raw", stamp_ns, stamp_ns, image_cdr(i))
        text = (tmp_path / "a" / "metadata.yaml").read_text()
        found = yaml.safe_load(text)["rosbag2_bagfile_information"]
        assert found["relative_file_paths"] == ["a_0.mcap", "a_1.mcap"]
        assert {t["topic_metadata"]["name"] for t in found["topics_with_message_count"]} == {
            "/sl/reconstruct/settings", "/sl/camera/image_raw"
        }  # fmt: skip
        numbers, lost = images_in(tmp_path / "a")
        assert numbers == list(range(5))
        assert all("the end is missing" in line for line in lost)


def test_a_file_that_the_metadata_do_not_name_is_read_all_the_same(tmp_path: Path) -> None:
    """A recorder that is killed between a split and its metadata."""
    record(tmp_path / "a", split_bytes=4 * SHAPE[0] * SHAPE[1])
    metadata = tmp_path / "a" / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"]["relative_file_paths"].pop()
    metadata.write_text(yaml.safe_dump(content))
    numbers, lost = images_in(tmp_path / "a")
    assert numbers == list(range(COUNT))
    assert any("a_2.mcap" in line for line in lost)


@pytest.mark.parametrize("cut", [0.37, 0.99])
def test_a_repaired_recording_is_whole_for_foreign_readers(tmp_path: Path, cut: float) -> None:
    record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    file.write_bytes(file.read_bytes()[: int(cut * file.stat().st_size)])
    numbers, lost = images_in(tmp_path / "a")
    assert lost
    assert main(["repair", str(tmp_path / "a"), "--output", str(tmp_path / "b")]) == 0
    assert images_in(tmp_path / "b") == (numbers, [])
    with AnyReader([tmp_path / "b"]) as reader:
        assert reader.message_count == len(numbers) + 1
    with (tmp_path / "b" / "b_0.mcap").open("rb") as opened:
        assert make_reader(opened, validate_crcs=True).get_summary() is not None
    assert main(["repair", str(tmp_path / "a"), "--output", str(tmp_path / "b")]) == 1  # taken


def test_nothing_can_be_repaired_of_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"x" * 100)
    assert main(["repair", str(tmp_path / "a.mcap"), "--output", str(tmp_path / "b")]) == 1
    assert not (tmp_path / "b").exists()


def test_a_damaged_summary_is_noticed(tmp_path: Path) -> None:
    """Any bit of it: its checksum is wrong then, and the file is followed record by record."""
    ends = record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    content = file.read_bytes()
    for place in np.random.default_rng(1).integers(ends[-1] + 13, len(content) - 8, size=25):
        hurt = bytearray(content)
        hurt[place] ^= 1 << int(place) % 8
        file.write_bytes(hurt)
        assert images_in(file)[0] == list(range(COUNT))


def test_a_damaged_image_is_left_out_and_told(tmp_path: Path) -> None:
    ends = record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    content = bytearray(file.read_bytes())
    content[ends[4] + 60_000] ^= 1  # one bit, in the pixels of image 5
    file.write_bytes(content)
    numbers, lost = images_in(tmp_path / "a")
    assert numbers == [i for i in range(COUNT) if i != 5]
    assert len(lost) == 1
    assert "checksum" in lost[0]


def test_a_damaged_summary_costs_nothing(tmp_path: Path) -> None:
    ends = record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    content = bytearray(file.read_bytes())
    content[ends[-1] + 13 : ends[-1] + 200] = bytes(187)
    file.write_bytes(content)
    numbers, _ = images_in(file)
    assert numbers == list(range(COUNT))


_ENDLESS = """
import sys, time
from pathlib import Path
sys.path[:0] = {path!r}
from sl_bringup.bag.bag_recorder import BagRecorder
from sl_bringup.bag.bag_writer import BagWriter, topic_qos
from sl_common.topics import POSE, IMAGE
from test_record import image_cdr
with BagRecorder(Path({bag!r})) as bag:
    for topic in (POSE, IMAGE):
        bag.add_topic("/sl/" + topic.name, topic.msgtype, topic_qos(topic))
    frame = image_cdr(0)
    while True:
        now = time.time_ns()
        bag.write("/sl/stage/pose", now, now, bytes(64))
        if now // 100_000_000 % 3 == 0:
            bag.write("/sl/camera/image_raw", now, now, frame)
        bag.tick()
        print(now, flush=True)
        time.sleep(0.01)
"""


def test_a_killed_recorder_loses_less_than_a_second(tmp_path: Path) -> None:
    code = _ENDLESS.format(path=sys.path, bag=str(tmp_path / "a"))
    with subprocess.Popen((sys.executable, "-c", code), stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        written = []
        while not written or written[-1] - written[0] < 1_300_000_000:
            written.append(int(child.stdout.readline()))
        child.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        written += [int(line) for line in child.stdout.read().split()]
    with open_bag(tmp_path / "a") as bag:
        kept = {raw.received_ns for raw in bag.raw(IMAGE, POSE)}
        assert bag.notes
        assert bag.lost
    assert kept >= {stamp_ns for stamp_ns in written if stamp_ns < killed_ns - 1_000_000_000}
    assert kept <= {*written, max(kept)}


def test_triggers_are_found_without_reading_images(tmp_path: Path) -> None:
    """A quick look does not check what it does not read: the damaged image is not noticed."""
    ends = record(tmp_path / "a")
    file = tmp_path / "a" / "a_0.mcap"
    content = bytearray(file.read_bytes())
    content[ends[4] + 60_000] ^= 1
    file.write_bytes(content)
    with open_bag(tmp_path / "a") as bag:
        assert [m.message.data for m in bag.messages(SETTINGS, quick=True)] == ["{}"]
        assert len(list(bag.messages(IMAGE, quick=True))) == COUNT
        assert not list(bag.messages(TRIGGER, CALIBRATION))
        assert not bag.lost


def test_a_taken_name_and_an_unknown_type_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(BagError, match="exists"):
        BagRecorder(tmp_path / "a")
    with BagRecorder(tmp_path / "b") as bag, pytest.raises(BagError, match="foo_msgs"):
        bag.add_topic("/x", "foo_msgs/msg/Bar", topic_qos(IMAGE))


@pytest.mark.parametrize(
    ("words", "expected"), [("0", 0), ("500MB", 500_000_000), ("1.5 GB", 1_500_000_000)]
)
def test_sizes(words: str, expected: int) -> None:
    assert size_bytes(words) == expected


@pytest.mark.parametrize("words", ["", "2 apples", "-1", "GB"])
def test_sizes_that_are_none(words: str) -> None:
    with pytest.raises(ConfigError, match="size"):
        size_bytes(words)


def test_a_sequence_is_smaller_than_the_queue() -> None:
    """What is offered on replay must hold the longest burst."""
    assert (
        max(len(named(name)) for name in ("precise", "paper", "precise-rows"))
        <= topic_qos(IMAGE).depth
    )


@pytest.mark.parametrize("size", ["5", "0.9MB"])
def test_a_split_without_a_unit_does_not_make_thousands_of_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], size: str
) -> None:
    assert main(["record", "--output", str(tmp_path / "bag"), "--split", size]) == 1
    assert "expected 1MB at least" in capsys.readouterr().err


def test_a_log_hears_only_of_what_changed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = itertools.count(0.0, 60.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(now_s))
    status = StatusLine("recording")
    for text in ("nothing", "nothing", "nothing", "one message"):
        status.show(text)
    assert capsys.readouterr().err == "recording: nothing\nrecording: one message\n"
