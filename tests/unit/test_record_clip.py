"""Clips: what is in them, by the public reader, against the recording they are of."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from PIL import Image, ImageSequence

from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures.recording import film, trajectory_of
from fullswarm.record.clip import clip, range_of
from fullswarm.record.playback import RecordedSwarm
from fullswarm.record.recording import Recording, Schema
from tests.unit.test_record_playback import START_NS, places, record


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record(path, 20.0)
    return path


def read(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def test_a_clip_holds_all_messages_of_its_part_and_what_was_known_before(file: Path, tmp_path: Path) -> None:
    out, first_ns = tmp_path / "clip.mcap", read(file)[0][1]
    found = clip(file, out, range_of(file, "8", "13"))
    assert found.whole
    assert out.stat().st_mode & 0o777 == 0o600
    begin_ns, end_ns = first_ns + 8 * 10**9, first_ns + 13 * 10**9
    made, source = read(out), read(file)
    inside = [each for each in source if begin_ns <= each[1] <= end_ns]
    earlier = [each for each in made if each[2] < begin_ns]
    assert sorted(each for each in made if each[2] >= begin_ns) == sorted(inside)
    assert {each[1] for each in earlier} == {begin_ns}
    newest = {topic: (when, data) for topic, when, _, data in source if when < begin_ns}
    assert {topic: (published, data) for topic, _, published, data in earlier} == newest
    assert "/behaviour/request" in newest  # 5 s in, and told again at the beginning of the clip
    assert found.about["fullswarm.clip"]["source"] == "run.mcap"
    assert found.about["fullswarm"]["swarm"] == "lab"
    assert "fleet.toml" in found.attachments


def test_a_clip_can_be_shown_and_cut_again(file: Path, tmp_path: Path) -> None:
    out, again = tmp_path / "clip.mcap", tmp_path / "again.mcap"
    clip(file, out, range_of(file, "8", "13"))
    assert RecordedSwarm(out).swarm == "lab"
    assert clip(out, again, range_of(out, "1", "2")).seconds == pytest.approx(1.0, abs=0.1)


def test_the_newest_of_each_parameter_is_kept(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "clip.mcap"
    recording = Recording(path)
    schema = Schema("fullswarm.ParamChanged/1", "jsonschema", b"{}", "json")
    for number in range(10):
        data = json.dumps({"layer": "core", "entry": {"key": f"group/{number % 3}", "value": number}}).encode()
        recording.write("/params/core/changed", "core", schema, START_NS + number * 10**9, data)
    recording.close()
    clip(path, out, range_of(path, "8.5", ""))
    values = [json.loads(data)["entry"]["value"] for *_, data in read(out)]
    assert sorted(values[:3]) == [6, 7, 8]
    assert values[3:] == [9]


@pytest.mark.parametrize("text", ["x", "nan", "1e99", "12:03", "2026-13-01T00:00:00", "9999-12-31T23:59:59+00:00x"])
def test_a_time_that_is_none_is_refused(file: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="--from"):
        range_of(file, text, "")


def test_times_of_day_are_those_of_the_recording(file: Path) -> None:
    first_ns = read(file)[0][1]
    found = range_of(file, "2027-01-15T08:00:05+00:00", "2027-01-15T08:00:06+00:00")
    assert found.from_ns - first_ns == pytest.approx(5e9, abs=1e9)


def test_what_cannot_be_is_refused_in_words(file: Path, tmp_path: Path) -> None:
    there = tmp_path / "there.mcap"
    there.touch()
    with pytest.raises(ConfigError, match="there already"):
        clip(file, there, range_of(file, "1", "2"))
    with pytest.raises(ConfigError, match="nothing was recorded"):
        clip(file, tmp_path / "a.mcap", range_of(file, "1000", ""))
    assert not (tmp_path / "a.mcap").exists()
    with pytest.raises(ConfigError, match="nothing is between"):
        range_of(file, "5", "4")
    with pytest.raises(ConfigError, match="cannot make"):
        clip(file, tmp_path / "a.bag", range_of(file, "1", "2"))


def test_a_film_shows_robots_where_the_file_says(file: Path, tmp_path: Path) -> None:
    wanted = range_of(file, "4", "8")
    found = trajectory_of(file, wanted)
    assert found.ids == ("r1", "r2")
    assert tuple(found.bounds_m) == (0.0, 0.0, 7.0, 6.0)
    for row in (0, 15, -1):
        for column, robot in enumerate(found.ids):
            at_s = float(found.time_s[row])
            assert tuple(found.pose[row, column, :2]) == pytest.approx(places(file, at_s)[robot], abs=0.02)
    assert (found.time_s[0], found.time_s[-1]) == pytest.approx((4.0, 8.0), abs=0.11)
    out = tmp_path / "clip.gif"
    count = film(file, out, range_of(file, "4", "5"), 1.0, 320)
    with Image.open(out) as picture:
        assert sum(1 for _ in ImageSequence.Iterator(picture)) == count == 11
