"""Recordings: other readers agree with what is written; bags of others are read."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sl_bench.world.reference_rig import reference_rig
from sl_bringup.bag.bag_writer import BagWriter, Storage, new_bag
from sl_bringup.bag.bags import interface_dir, natural_key, open_bag, topic_names, typestore
from sl_common.errors import BagError
from sl_common.topics import CALIBRATION, IMAGE, POSE, TRIGGER
from sl_reconstruct.model.calibration_file import parse_calibration, rig_hash
from support.paths import DATA
from support.scenes.made_bags import COUNT, START_NS, count_images, fill, frames

ROSBAG2 = DATA / "rosbag2"
needs_rosbag2 = pytest.mark.skipif(not ROSBAG2.is_dir(), reason=f"no data in {ROSBAG2}")


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
