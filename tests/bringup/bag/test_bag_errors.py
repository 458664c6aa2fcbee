"""Damaged recordings and those of something else: read in part, and said so, or refused."""

from __future__ import annotations

import re
import sqlite3
import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer

from sl_bringup.bag.bag_writer import new_bag
from sl_bringup.bag.bags import make_message, open_bag, topic_names, typestore
from sl_common.errors import BagError
from sl_common.messages import header
from sl_common.topics import IMAGE, POSE, TRIGGER
from support.scenes.made_bags import COUNT, START_NS, count_images, fill, frames


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
