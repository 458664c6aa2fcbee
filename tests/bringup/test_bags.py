"""Recordings: foreign readers agree with what is written; damaged ones are read or refused."""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sl_bench.world.reference_rig import reference_rig
from sl_bringup.bag.bag_writer import BagWriter, Storage, new_bag
from sl_bringup.bag.bags import (
    interface_dir,
    make_message,
    natural_key,
    open_bag,
    topic_names,
    typestore,
)
from sl_common.errors import BagError
from sl_common.messages import header
from sl_common.topics import CALIBRATION, IMAGE, POSE, TRIGGER
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.model.calibration_file import Calibration, parse_calibration, rig_hash
from support.paths import DATA

ROSBAG2 = DATA / "rosbag2"
needs_rosbag2 = pytest.mark.skipif(not ROSBAG2.is_dir(), reason=f"no data in {ROSBAG2}")

START_NS = 1_700_000_000_000_000_000
COUNT = 11


def frames(dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.integers(0, np.iinfo(dtype).max, (COUNT, 48, 64), dtype)


def fill(bag: BagWriter, images: np.ndarray) -> None:
    sequence = named("paper")
    bag.calibration(Calibration(reference_rig()), "made up", START_NS)
    for i, image in enumerate(images):
        stamp_ns = START_NS + i * 10_000_001
        bag.trigger(sequence, i, 7, stamp_ns, 0.005)
        bag.pose((0.001, -0.002, 0.003), stamp_ns)
        bag.image(image, stamp_ns, stamp_ns + 5_000_000)


@pytest.fixture(params=["mcap", "sqlite3"])
def storage(request: pytest.FixtureRequest) -> Storage:
    return request.param


@pytest.fixture
def bag_path(tmp_path: Path, storage: Storage) -> Path:
    with new_bag(tmp_path / "a", storage) as bag:
        fill(bag, frames())
    return tmp_path / "a"


def test_what_is_written_is_read(bag_path: Path) -> None:
    images = frames()
    with open_bag(bag_path) as bag:
        assert (bag.namespace, bag.lost, bag.notes) == ("/sl", [], [])
        found = list(bag.messages())
    assert [r.topic for r in found[:4]] == [CALIBRATION, TRIGGER, POSE, IMAGE]
    got = [r for r in found if r.topic == IMAGE]
    assert [r.received_ns for r in got] == [
        START_NS + i * 10_000_001 + 5_000_000 for i in range(COUNT)
    ]
    for r, image in zip(got, images, strict=True):
        assert (r.message.encoding, r.message.height, r.message.width) == ("mono8", 48, 64)
        assert np.array_equal(r.message.data.reshape(48, 64), image)
    triggers = [r.message for r in found if r.topic == TRIGGER]
    assert [(t.scan_id, t.index, t.count, t.sequence) for t in triggers] == [
        (7, i, COUNT, "paper") for i in range(COUNT)
    ]
    assert [t.pattern.shift_px for t in triggers[8:]] == [1, 2, 3]
    calibration = next(r.message for r in found if r.topic == CALIBRATION)
    assert calibration.hash == rig_hash(reference_rig())
    assert rig_hash(parse_calibration(calibration.yaml).rig) == calibration.hash


def test_sixteen_bit_images_are_little_endian(tmp_path: Path) -> None:
    images = frames(np.uint16)
    with new_bag(tmp_path / "a") as bag:
        fill(bag, images)
    with open_bag(tmp_path / "a") as bag:
        message = next(bag.messages(IMAGE)).message
    assert (message.encoding, message.step, message.is_bigendian) == ("mono16", 128, 0)
    assert np.array_equal(np.frombuffer(message.data, "<u2").reshape(48, 64), images[0])


def test_independent_reader_of_rosbags_agrees(bag_path: Path) -> None:
    """The types come from the bag itself here, not from our message files."""
    images = frames()
    with AnyReader([bag_path]) as reader:
        connections = [c for c in reader.connections if c.topic == "/sl/camera/image_raw"]
        for i, (connection, _, raw) in enumerate(reader.messages(connections=connections)):
            message: Any = reader.deserialize(raw, connection.msgtype)
            assert np.array_equal(message.data, images[i].reshape(-1))


def test_mcap_library_agrees(tmp_path: Path) -> None:
    """mcap and mcap-ros2-support share no code with rosbags."""
    images = frames()
    with new_bag(tmp_path / "a") as bag:
        fill(bag, images)
    with (tmp_path / "a" / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [(c.topic, m, d) for _, c, m, d in reader.iter_decoded_messages()]
    got = [d for topic, _, d in decoded if topic == "/sl/camera/image_raw"]
    assert [bytes(d.data) for d in got] == [image.tobytes() for image in images]
    triggers = [(m, d) for topic, m, d in decoded if topic == "/sl/projector/trigger"]
    assert len(triggers) == COUNT
    for i, (message, trigger) in enumerate(triggers):
        stamp = trigger.header.stamp
        assert stamp.sec * 1_000_000_000 + stamp.nanosec == message.log_time
        assert (trigger.index, trigger.pattern.kind, trigger.exposure_s) == (i, "gray", 0.005)
        assert (trigger.dmd_columns, trigger.dmd_rows) == (1024, 768)
    pose = next(d for topic, _, d in decoded if topic == "/sl/stage/pose")
    assert (pose.pose.position.x, pose.pose.position.z) == (0.001, 0.003)
    assert pose.header.frame_id == "sl_world"


def test_metadata_lets_the_stock_player_play(bag_path: Path, storage: Storage) -> None:
    """Every key that rosbag2's yaml.hpp and qos.cpp (jazzy, version 9) ask for, with its form."""
    info = yaml.safe_load((bag_path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert info["version"] == 9
    assert info["storage_identifier"] == storage
    assert info["message_count"] == 1 + 3 * COUNT
    assert info["starting_time"]["nanoseconds_since_epoch"] == START_NS
    suffix = "mcap" if storage == "mcap" else "db3"
    assert info["relative_file_paths"] == [f"a.{suffix}"]
    assert (bag_path / f"a.{suffix}").is_file()
    topics = {t["topic_metadata"]["name"]: t["topic_metadata"] for t in _topics(info)}
    assert set(topics) == {
        "/sl/projector/trigger", "/sl/camera/image_raw", "/sl/stage/pose", "/sl/calibration/rig",
    }  # fmt: skip
    for name, topic in topics.items():
        assert topic["serialization_format"] == "cdr"
        assert topic["type_description_hash"].startswith("RIHS01_")
        (qos,) = topic["offered_qos_profiles"]
        latched = name == "/sl/calibration/rig"
        assert qos["history"] == "keep_last"
        assert qos["depth"] == (1 if latched else 64)
        assert qos["reliability"] == "reliable"
        assert qos["durability"] == ("transient_local" if latched else "volatile")
        assert qos["liveliness"] == "automatic"
        assert qos["avoid_ros_namespace_conventions"] is False
        for duration in ("deadline", "lifespan", "liveliness_lease_duration"):
            assert qos[duration] == {"sec": 9223372036, "nsec": 854775807}


def _topics(info: dict[str, Any]) -> list[dict[str, Any]]:
    return info["topics_with_message_count"]


def test_a_failed_recording_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), new_bag(tmp_path / "a") as bag:
        fill(bag, frames())
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_a_taken_name_is_refused(bag_path: Path) -> None:
    with pytest.raises(BagError, match="exists already"), new_bag(bag_path):
        pass


def count_images(path: Path) -> tuple[int, list[str], list[str]]:
    with open_bag(path) as bag:
        images = sum(1 for _ in bag.messages(IMAGE))
        return images, bag.lost, bag.notes


def test_bag_without_metadata_is_read_whole(bag_path: Path) -> None:
    (bag_path / "metadata.yaml").unlink()
    images, lost, notes = count_images(bag_path)
    assert (images, lost) == (COUNT, [])
    assert "no metadata.yaml" in notes[0]


def test_bare_file_is_read_whole(bag_path: Path) -> None:
    file = next(p for p in bag_path.iterdir() if p.suffix in (".mcap", ".db3"))
    assert count_images(file) == (COUNT, [], [])


def test_broken_metadata_costs_nothing_but_is_told(bag_path: Path) -> None:
    text = (bag_path / "metadata.yaml").read_text()
    (bag_path / "metadata.yaml").write_text(text[: len(text) // 2])
    images, lost, _ = count_images(bag_path)
    assert images == COUNT
    assert lost


def one_message_per_chunk(path: Path) -> list[int]:
    """A bag whose images lie in chunks of their own; the byte at which each chunk ends."""
    store = typestore()
    ends = []
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection("/sl/camera/image_raw", IMAGE.msgtype, typestore=store)
        for i, image in enumerate(frames()):
            message = make_message(
                IMAGE.msgtype, header=header(START_NS + i, "c", make_message), height=48, width=64,
                encoding="mono8", is_bigendian=0, step=64, data=image.reshape(-1),
            )  # fmt: skip
            writer.write(connection, START_NS + i, store.serialize_cdr(message, IMAGE.msgtype))
            storage: Any = writer.storage
            storage.close_chunk()
            index = storage.chunks[-1].getvalue()  # its chunk index record: times, start, length
            ends.append(sum(struct.unpack_from("<QQ", index, 16)))
    return ends


def test_a_truncated_mcap_gives_all_whole_chunks(tmp_path: Path) -> None:
    ends = one_message_per_chunk(tmp_path / "a")
    file = tmp_path / "a" / "a.mcap"
    content = file.read_bytes()
    for cut in (ends[-1] - 1, ends[4], ends[4] + 5, ends[4] + 2000, ends[0] + 1, 100):
        file.write_bytes(content[:cut])
        images, lost, _ = count_images(tmp_path / "a")
        assert images == sum(end <= cut for end in ends)
        assert any("end is missing" in line for line in lost)
        assert any(f"of {cut} bytes" in line for line in lost)


def test_a_corrupted_chunk_is_told(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a") as bag:
        fill(bag, frames())
    file = tmp_path / "a" / "a.mcap"
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    file.write_bytes(content)
    images, lost, _ = count_images(tmp_path / "a")
    # rosbags writes no checksum, so damage inside an image cannot be seen; lost records are told.
    assert images == COUNT or lost


def test_a_truncated_sqlite_file_is_told(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a", "sqlite3") as bag:
        fill(bag, frames())
    file = tmp_path / "a" / "a.db3"
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    try:
        images, lost, _ = count_images(tmp_path / "a")
    except BagError as error:
        assert "cannot be read" in str(error)
    else:
        assert images < COUNT
        assert lost


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"hello"])
@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".txt"])
def test_what_is_no_bag_is_refused(tmp_path: Path, content: bytes, suffix: str) -> None:
    path = tmp_path / f"file{suffix}"
    path.write_bytes(content)
    with pytest.raises(BagError, match="file"), open_bag(path):
        pass


def test_a_file_of_something_else_is_not_called_unfinished(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no recording at all " * 20)
    with pytest.raises(BagError, match="magic") as refused, open_bag(tmp_path / "a.mcap"):
        pass
    assert "not ended" not in str(refused.value)


def test_no_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="there is no bag"), open_bag(tmp_path / "none"):
        pass
    with pytest.raises(BagError, match="cannot be read"), open_bag(tmp_path):
        pass


def test_a_topic_of_another_type_is_refused(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        writer.add_connection(
            "/sl/camera/image_raw", "sensor_msgs/msg/CompressedImage", typestore=typestore()
        )
    with pytest.raises(BagError, match="CompressedImage"), open_bag(tmp_path / "a") as bag:
        list(bag.messages())


def test_another_version_of_a_message_is_refused(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a", "sqlite3") as bag:
        fill(bag, frames())
    file = tmp_path / "a" / "a.db3"
    with sqlite3.connect(file) as database:
        database.execute(
            "UPDATE topics SET type_description_hash='RIHS01_0' WHERE name LIKE '%trigger'"
        )
    (tmp_path / "a" / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="another version"), open_bag(file) as bag:
        list(bag.messages(TRIGGER))


def test_garbage_in_a_message_is_left_out_and_told(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection(
            "/sl/projector/trigger", TRIGGER.msgtype, typestore=typestore()
        )
        writer.write(connection, 1, b"\x00\x01\x00\x00garbage")
    with open_bag(tmp_path / "a") as bag:
        assert not list(bag.messages())
        assert len(bag.lost) == 1
        assert "a message of 11 bytes on projector/trigger" in bag.lost[0]


def test_a_topic_without_a_type_costs_only_itself(tmp_path: Path) -> None:
    """mcap calls a schema's number 0 for none: written by mcap's own library."""
    with new_bag(tmp_path / "bag") as bag:
        bag.pose((0.001, -0.002, 0.003), START_NS)
    with open_bag(tmp_path / "bag") as bag:
        (pose,) = bag.raw(POSE)
    definition = typestore().generate_msgdef(POSE.msgtype)[0].encode()
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(POSE.msgtype, "ros2msg", definition)
        for topic, number in ((POSE.name, schema), (IMAGE.name, 0)):
            channel = writer.register_channel(f"/sl/{topic}", "cdr", number)
            writer.add_message(channel, START_NS, bytes(pose.data), START_NS)
        writer.finish()
    with open_bag(tmp_path / "a.mcap") as bag:
        (found,) = bag.messages(POSE, IMAGE)
        assert found.message.pose.position.x == 0.001
        assert bag.lost == ["a.mcap: what type /sl/camera/image_raw has cannot be read"]


def foreign_poses(path: Path, topics: list[str]) -> None:
    """Fifty messages of each topic, announced in turn, in one chunk without checksum."""
    definition = typestore().generate_msgdef(POSE.msgtype)[0].encode()
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(POSE.msgtype, "ros2msg", definition)
        for topic in topics:
            channel = writer.register_channel(topic, "cdr", schema)
            for i in range(50):
                writer.add_message(channel, START_NS + i, bytes(100), START_NS)
        writer.finish()


def test_a_damaged_length_is_told_without_a_checksum(tmp_path: Path) -> None:
    """The library's `breakup_chunk` takes what is left of the chunk for the message, silently."""
    foreign_poses(tmp_path / "a.mcap", [f"/sl/{POSE.name}"])
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    messages = [m.start() for m in re.finditer(rb"\x05\x7a" + bytes(7), content)]
    assert len(messages) == 50
    content[messages[20] + 3] ^= 1
    (tmp_path / "a.mcap").write_bytes(content)
    with open_bag(tmp_path / "a.mcap") as bag:
        assert len(list(bag.raw(POSE))) == 20
        assert any("reaches beyond its chunk" in line for line in bag.lost)


def test_a_topic_announced_late_is_found_without_a_summary(tmp_path: Path) -> None:
    topics = [f"/sl/{POSE.name}", "/sl/late"]
    foreign_poses(tmp_path / "a.mcap", topics)
    content = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(content[:-20])
    with open_bag(tmp_path / "a.mcap") as bag:
        assert topic_names(bag) == sorted(topics)
        assert sum(1 for _ in bag.everything()) == 100


def test_two_rigs_need_a_name(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        for name in ("/left", "/right/inner"):
            writer.add_connection(f"{name}/camera/image_raw", IMAGE.msgtype, typestore=typestore())
    with pytest.raises(BagError, match="/left, /right/inner"), open_bag(tmp_path / "a"):
        pass
    with open_bag(tmp_path / "a", "right/inner") as bag:
        assert bag.namespace == "/right/inner"


def test_other_namespaces_are_found(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a", namespace="/cell/sl3") as bag:
        fill(bag, frames())
    with open_bag(tmp_path / "a") as bag:
        assert bag.namespace == "/cell/sl3"
        assert sum(1 for _ in bag.messages(TRIGGER)) == COUNT


def test_message_files_are_found_where_they_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share = tmp_path / "share" / "sl_interfaces"
    shutil.copytree(interface_dir(), share / "msg")
    monkeypatch.setattr("sl_bringup.bag.bags.__file__", str(tmp_path / "lib" / "x" / "bags.py"))
    monkeypatch.setattr("sys.prefix", str(tmp_path / "nowhere"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/opt/none:{tmp_path}")
    assert interface_dir() == share / "msg"
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    with pytest.raises(BagError, match="no message definitions"):
        interface_dir()
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    assert interface_dir() == share / "msg"


def test_names_sort_as_people_count() -> None:
    names = ["img10.png", "img9.png", "img2b1.png", "IMG2a3.png", "a.png"]
    ordered = sorted((Path(n) for n in names), key=natural_key)
    assert [p.name for p in ordered] == [
        "a.png", "IMG2a3.png", "img2b1.png", "img9.png", "img10.png",
    ]  # fmt: skip


def foreign_bags() -> list[Path]:
    """Every bag directory of ROS 2's own tests, and the bare files."""
    if not ROSBAG2.is_dir():
        return []
    with_metadata = [p.parent for p in ROSBAG2.rglob("metadata.yaml")]
    files = [*ROSBAG2.rglob("*.mcap"), *ROSBAG2.rglob("*.db3")]
    bare = [f for f in files if not (f.parent / "metadata.yaml").is_file()]
    return sorted({*with_metadata, *bare, *(f.parent for f in bare)})


@needs_rosbag2
@pytest.mark.parametrize("path", foreign_bags(), ids=lambda p: str(p.relative_to(ROSBAG2)))
def test_bags_of_ros_2_are_read_or_refused_for_the_right_reason(path: Path) -> None:
    if "wrong_rmw" in str(path):
        with pytest.raises(BagError, match="wrong_format"), open_bag(path):
            pass
        return
    with open_bag(path) as bag:
        assert bag.lost == []
        topics = topic_names(bag)
        assert list(bag.messages()) == []  # none of them is a scan
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        info = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
        assert topics == sorted({t["topic_metadata"]["name"] for t in _topics(info)})
    else:
        assert topics


@needs_rosbag2
def test_every_message_of_ros_2s_bags_is_reachable() -> None:
    """As many as metadata.yaml counts, although some word the QoS differently in the file."""
    checked = 0
    for path in foreign_bags():
        if "wrong_rmw" in str(path) or not (path / "metadata.yaml").is_file():
            continue
        info = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        with open_bag(path) as bag:
            storages = [file.storage for file in bag._files]
            found = sum(1 for s in storages for _ in s.messages(s.connections))
        assert found == info["message_count"], path
        checked += 1
    assert checked >= 19


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_compressed_bags_are_read(
    tmp_path: Path, mode: CompressionMode, plugin: StoragePlugin
) -> None:
    writer = Writer(tmp_path / "a", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    images = frames()
    with writer:
        bag_writer = BagWriter(writer, "/sl")
        fill(bag_writer, images)
    with open_bag(tmp_path / "a") as bag:
        got = [r.message.data.reshape(48, 64) for r in bag.messages(IMAGE)]
        assert bag.lost == []
    assert np.array_equal(got, images)


def test_a_missing_part_of_a_split_bag_is_told(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a") as bag:
        fill(bag, frames())
    metadata = tmp_path / "a" / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"]["relative_file_paths"].append("a_1.mcap")
    metadata.write_text(yaml.safe_dump(content))
    images, lost, _ = count_images(tmp_path / "a")
    assert images == COUNT
    assert "a_1.mcap" in lost[0]


def test_fewer_messages_than_were_recorded_is_told(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a") as bag:
        fill(bag, frames())
    metadata = tmp_path / "a" / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace("message_count: 34", "message_count: 40"))
    assert "hold 34 messages, 40 were recorded" in count_images(tmp_path / "a")[1][0]
