"""What is read from images: partition tables, FATs, checksums, compressions."""

from __future__ import annotations

import gzip
import hashlib
import json
import lzma
import os
import struct
import subprocess
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.deploy.flash import fat, image
from fullswarm.deploy.flash.fat import HEAD_BYTES, read_partitions
from fullswarm.deploy.flash.plan import read_head
from fullswarm.errors import ConfigError
from tests.unit.flash_lab import MEGA, fsck, make_fat, make_image, tool


@pytest.mark.parametrize("table", ["dos", "gpt"])
def test_partitions_are_those_that_sfdisk_sees(tmp_path: Path, table: str) -> None:
    path = make_image(tmp_path / "a.img", {}, table=table)
    said = json.loads(subprocess.run([tool("sfdisk"), "-J", path], capture_output=True, check=True).stdout)
    wanted = [(each["start"] * 512, each["size"] * 512) for each in said["partitiontable"]["partitions"]]
    found = read_partitions(path.read_bytes()[:HEAD_BYTES], "a.img")
    assert [(each.start_bytes, each.size_bytes) for each in found] == wanted
    assert len(found) == 2


@given(st.binary(max_size=4096), st.booleans())
def test_no_bytes_make_the_table_reader_fail_otherwise(junk: bytes, marked: bool) -> None:
    head = junk.ljust(512, b"\0")[:510] + b"\x55\xaa" + junk[512:] if marked else junk
    try:
        found = read_partitions(head, "junk")
    except ConfigError:
        return
    assert all(each.size_bytes > 0 and each.start_bytes >= 512 for each in found)


@given(st.lists(st.tuples(st.integers(0, 500), st.binary(min_size=1, max_size=8)), max_size=12))
def test_a_broken_gpt_is_refused_or_read_within_its_disk(damage: list[tuple[int, bytes]]) -> None:
    head = bytearray(MEGA // 16)
    head[446:462] = struct.pack("<B3sB3sII", 0, b"", 0xEE, b"", 1, 1000)
    head[510:512] = b"\x55\xaa"
    head[512:604] = struct.pack(
        "<8sIIIIQQQQ16sQIII", b"EFI PART", 0x10000, 92, 0, 0, 1, 999, 34, 966, b"", 2, 128, 128, 0
    )
    head[1024:1152] = struct.pack("<16s16sQQQ72s", b"t" * 16, b"u" * 16, 64, 127, 0, "boot".encode("utf-16-le"))
    assert read_partitions(bytes(head), "sound")[0].name == "boot"
    for at, data in damage:
        head[446 + at : 446 + at + len(data)] = data
    try:
        for each in read_partitions(bytes(head), "damaged"):
            assert 0 < each.start_bytes < each.end_bytes
    except ConfigError:
        pass


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 89), st.integers(0, 255)), max_size=6))
def test_a_broken_fat_header_is_no_fat_or_a_bounded_one(
    tmp_path_factory: pytest.TempPathFactory, damage: list[tuple[int, int]]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    sound = folder / "sound.fat"
    if not sound.exists():
        make_image(folder / "sound.img", {})
        sound.write_bytes((folder / "sound.img").read_bytes()[MEGA : MEGA + 65536])
    raw = bytearray(sound.read_bytes())
    for at, value in damage:
        raw[at] = value
    path = folder / "damaged.img"
    path.write_bytes(bytes(MEGA) + bytes(raw))
    number = os.open(path, os.O_RDONLY)
    try:
        partition = read_partitions((folder / "sound.img").read_bytes()[:HEAD_BYTES], "x")[0]
        volume = fat.read_volume(number, partition)
    finally:
        os.close(number)
    assert volume is None or 0 <= volume.free_bytes <= partition.size_bytes


@pytest.mark.parametrize(("bits", "size"), [(12, 3 * MEGA), (16, 24 * MEGA), (32, 40 * MEGA)])
def test_label_id_and_free_room_are_those_that_mtools_sees(tmp_path: Path, bits: int, size: int) -> None:
    path = make_image(tmp_path / "a.img", {"a.bin": b"x" * 70_000}, fat=size, bits=bits, label="bootfs")
    number = os.open(path, os.O_RDONLY)
    try:
        volume = fat.boot_volume(number, "a.img")
    finally:
        os.close(number)
    said = subprocess.run([tool("mdir"), "-i", f"{path}@@{MEGA}", "::"], capture_output=True, text=True, check=True)
    free = next(line for line in said.stdout.splitlines() if "bytes free" in line)
    assert volume.free_bytes == int("".join(letter for letter in free if letter.isdigit()))
    assert f"Volume Serial Number is {volume.volume_id}" in said.stdout
    assert (volume.label, volume.kind) == ("bootfs", bits)


def test_the_boot_partition_is_the_one_with_a_usual_name(tmp_path: Path) -> None:
    path = make_image(tmp_path / "a.img", {}, label="EFI", table="gpt", root=8 * MEGA)
    second = tmp_path / "second.fat"
    make_fat(second, 8 * MEGA, "CIDATA", {}, bits=12)
    with path.open("r+b") as file:
        file.seek(25 * MEGA)
        file.write(second.read_bytes())
    source = read_head(path, tmp_path, lambda _: None)
    assert (source.volume.label, source.volume.start_bytes) == ("CIDATA", 25 * MEGA)


def test_files_that_do_not_fit_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    path = make_image(tmp_path / "a.img", fat=4 * MEGA, bits=12)
    before = path.read_bytes()
    source = read_head(path, tmp_path, lambda _: None)
    with pytest.raises(ConfigError, match=r"MB free, 5 MB are needed.*most of it is big"):
        fat.put_files(path, source.volume, {"small": b"x", "big": b"y" * 5 * MEGA})
    assert path.read_bytes() == before


def test_files_go_in_over_old_ones_and_fsck_agrees(tmp_path: Path) -> None:
    path = make_image(tmp_path / "a.img", {"user-data": b"short", "keep": b"kept"})
    source = read_head(path, tmp_path, lambda _: None)
    files = {"user-data": b"longer" * 10_000, "fullswarm/a/deep name.txt": b"1", "empty": b""}
    fat.put_files(path, source.volume, files)
    fat.put_files(path, source.volume, {"user-data": b"again"})
    fsck(path, 24 * MEGA)
    assert fat.fsck(path, source.volume) == "fsck.vfat: clean"
    assert fat.get_file(path, source.volume, "user-data") == b"again"
    assert fat.get_file(path, source.volume, "keep") == b"kept"
    assert fat.get_file(path, source.volume, "fullswarm/a/deep name.txt") == b"1"
    assert fat.get_file(path, source.volume, "nothing") is None
    assert fat.file_names(path, source.volume) == {"user-data", "keep", "fullswarm/", "empty"}


def test_a_damaged_fat_is_named(tmp_path: Path) -> None:
    path = make_image(tmp_path / "a.img", {"a": b"x" * 100_000, "b": b"y" * 100_000})
    source = read_head(path, tmp_path, lambda _: None)
    with path.open("r+b") as file:  # cut the chain of the first file, in both copies of the table
        file.seek(MEGA + 2048 + 6)
        file.write(b"\x00" * 40)
    tool("fsck.vfat")
    with pytest.raises(ConfigError, match="finds errors in the boot partition"):
        fat.fsck(path, source.volume)


# ---------------------------------------------------------------- whole images
def squeeze(path: Path, suffix: str) -> Path:
    packed = path.with_name(path.name + suffix)
    data = path.read_bytes()
    if suffix == ".xz":
        packed.write_bytes(lzma.compress(data, preset=0))
    elif suffix == ".gz":
        packed.write_bytes(gzip.compress(data, 1))
    elif suffix == ".zst":
        subprocess.run([tool("zstd"), "-q", str(path), "-o", str(packed)], check=True)
    return packed


@pytest.mark.parametrize("suffix", ["", ".xz", ".gz", ".zst"])
def test_all_compressions_give_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / "a.img"
    plain.write_bytes(os.urandom(500_000) + bytes(9_000_000) + os.urandom(500_000))
    with image.opened(squeeze(plain, suffix)) as stream:
        pieces = list(image.chunks(stream))
    assert b"".join(pieces) == plain.read_bytes()
    assert [len(each) for each in pieces[:-1]] == [image.CHUNK_BYTES] * (len(pieces) - 1)


@pytest.mark.parametrize("suffix", [".xz", ".gz", ".zst"])
def test_a_damaged_or_cut_image_says_so(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / "a.img"
    plain.write_bytes(os.urandom(1_000_000))
    packed = squeeze(plain, suffix)
    packed.write_bytes(packed.read_bytes()[:600_000])
    with pytest.raises(ConfigError, match=r"is damaged.*download it again"), image.opened(packed) as stream:
        list(image.chunks(stream))


@pytest.mark.parametrize("suffix", [".xz", ".gz", ".zst"])
def test_only_the_head_may_be_read(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / "a.img"
    plain.write_bytes(os.urandom(500_000) + bytes(8_000_000) + os.urandom(500_000))
    assert image.copy_head(squeeze(plain, suffix), 5_000_000, tmp_path / "head") == 5_000_000
    assert (tmp_path / "head").read_bytes() == plain.read_bytes()[:5_000_000]


def test_what_is_no_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unpack a \.zip first"), image.opened(tmp_path / "a.zip"):
        pass
    with pytest.raises(ConfigError, match="no such file"), image.opened(tmp_path / "a.img"):
        pass
    text = tmp_path / "page.img"
    text.write_text("<html>not found</html>" * 1000)
    with pytest.raises(ConfigError, match="has no partition table"):
        read_head(text, tmp_path, lambda _: None)
    cut = make_image(tmp_path / "cut.img", {})
    os.truncate(cut, 9 * MEGA)
    with pytest.raises(ConfigError, match="ends after 9 MB"):
        read_head(cut, tmp_path, lambda _: None)


def test_checksums_come_from_the_option_or_the_file_beside(tmp_path: Path) -> None:
    path = tmp_path / "os.img.xz"
    path.write_bytes(b"image")
    digest = hashlib.sha256(b"image").hexdigest()
    assert image.expected_sha256(path, None) is None
    (tmp_path / "os.img.xz.sha256").write_text(f"{'0' * 64}  other.img.xz\n{digest}  os.img.xz\n")
    assert image.expected_sha256(path, None) == digest
    assert image.expected_sha256(path, "A" * 64) == "a" * 64
    assert image.check_sha256(path, digest, lambda _: None) == digest
    with pytest.raises(ConfigError, match=f"its SHA-256 is {digest}, not {'a' * 64}"):
        image.check_sha256(path, "a" * 64, lambda _: None)
    with pytest.raises(ConfigError, match="64 hexadecimal digits"):
        image.expected_sha256(path, "abc")
    (tmp_path / "os.img.xz.sha256").write_text("<html>")
    with pytest.raises(ConfigError, match="holds no SHA-256"):
        image.expected_sha256(path, None)
