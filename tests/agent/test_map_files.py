"""nav2 map files: what we write reads back the same, what others write reads as nav2 reads it, what is broken says so."""

from __future__ import annotations

import math
import os
import struct
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from agent.flat_yaml import FlatYamlError, parse_flat_yaml
from agent.image_files import MAX_PIXELS, encode_pgm
from agent.map_files import MapFileError, MapSettings, cells_of, load_map, save_map
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

YAML = "image: map.pgm\nresolution: 0.05\norigin: [-1.5, 2.25, 0.1]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
CELLS = np.array([[FREE, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, OCCUPIED]], np.int8)


def nav2_value(shade: float, mode: str, negate: bool, occupied: float, free: float) -> int:
    """nav2's map_io.cpp, line by line: occupancy of one opaque gray pixel of shade 0 to 1."""
    occ = shade if negate else 1.0 - shade
    if mode == "trinary":
        return 100 if occupied < occ else 0 if occ < free else -1
    if mode == "scale":
        if occupied < occ:
            return 100
        return 0 if occ < free else round((occ - free) / (occupied - free) * 100)
    value = round(shade * 255)
    return value if 0 <= value <= 100 else -1


def trinary(value: int) -> int:
    return UNKNOWN if value < 0 else OCCUPIED if value >= 70 else FREE if value <= 30 else UNKNOWN


def written(tmp_path: Path, yaml: str, pgm: bytes | None = None) -> Path:
    (tmp_path / "map.pgm").write_bytes(encode_pgm(np.array([[0, 205, 254]], np.uint8)) if pgm is None else pgm)
    (tmp_path / "map.yaml").write_text(yaml)
    return tmp_path / "map.yaml"


@settings(suppress_health_check=[HealthCheck.too_slow])  # a busy machine draws arrays slowly, and that is no bug
@given(
    cells=hnp.arrays(np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.sampled_from([-1, 0, 100])),
    resolution_m=st.floats(0.001, 10.0),
    origin=st.builds(SE2, st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-3, 3)),
)
def test_a_map_reads_back_as_it_was_written(
    cells: np.ndarray, resolution_m: float, origin: SE2, tmp_path_factory: pytest.TempPathFactory
) -> None:
    grid = OccupancyGrid(cells, resolution_m, origin)
    yaml, _ = save_map(grid, tmp_path_factory.mktemp("maps") / "a.b")
    again = load_map(yaml)
    assert np.array_equal(again.cells, cells)
    assert math.isclose(again.resolution_m, resolution_m)
    assert np.allclose(again.origin.matrix(), origin.matrix(), atol=1e-9)


def test_the_lowest_row_is_the_last_of_the_image(tmp_path: Path) -> None:
    _, pgm = save_map(OccupancyGrid(CELLS, 0.05), tmp_path / "new" / "map.yaml")
    assert pgm.read_bytes() == b"P5\n3 2\n255\n" + bytes([205, 254, 0, 254, 0, 205])
    assert (tmp_path / "new" / "map.yaml").read_text().splitlines()[0] == "image: map.pgm"


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize(("occupied", "free"), [(0.65, 0.196), (0.65, 0.25), (0.9, 0.1)])
def test_every_shade_reads_as_nav2_reads_it(mode: str, negate: bool, occupied: float, free: float) -> None:
    settings = MapSettings("", 0.05, SE2.identity(), mode, negate, occupied, free)
    shades = np.arange(256, dtype=np.uint8).reshape(1, -1)
    expected = [trinary(nav2_value(v / 255, mode, negate, occupied, free)) for v in range(256)]
    assert cells_of(shades, settings)[0].tolist() == expected


def test_a_widespread_threshold_of_a_quarter_would_read_unknown_as_free() -> None:
    pixel = np.array([[205]], np.uint8)
    assert cells_of(pixel, MapSettings("", 0.05, SE2.identity(), free_thresh=0.25))[0, 0] == FREE
    assert cells_of(pixel, MapSettings("", 0.05, SE2.identity()))[0, 0] == UNKNOWN


WRITERS = {  # header of the image, YAML: as these programs write them, to the letter
    "nav2 map_saver, slam_toolbox": (
        "P5\n3 2\n255\n",
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2.25, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.25",
    ),
    "map_saver of ROS 1": (
        "P5\n# CREATOR: map_saver.cpp 0.050 m/pix\n3 2\n255\n",
        "image: map.pgm\nresolution: 0.050000\norigin: [-1.500000, 2.250000, 0.000000]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n\n",
    ),
    "Cartographer": (
        "P5\n# Cartographer map; 0.05 m/pixel\n3 2\n255\n",
        "image: map.pgm\nresolution: 0.05\norigin: [-1.5, 2.25, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
    ),
    "edited by hand on Windows": (
        "P5 3 2 255\n",
        "image: map.pgm   \r\nmode:   trinary\t\r\nresolution: .05 # m\r\norigin: [ -1.5, 2.25 , 0. ]  \r\nnegate: 0\r\n"
        "occupied_thresh: 0.65\r\nfree_thresh: 0.196  \r\n   \r\n",
    ),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_unknown_stays_unknown_in_files_as_others_write_them(writer: str, tmp_path: Path) -> None:
    header, yaml = WRITERS[writer]
    unknown = 128 if writer == "Cartographer" else 205
    grid = load_map(written(tmp_path, yaml, header.encode() + bytes([0, unknown, 254, 254, 254, unknown])))
    assert grid.cells.tolist() == [[FREE, FREE, UNKNOWN], [OCCUPIED, UNKNOWN, FREE]]
    assert (grid.origin, grid.resolution_m) == (SE2(-1.5, 2.25, 0.0), 0.05)


def test_another_gray_beside_it_makes_the_wide_threshold_meant(tmp_path: Path) -> None:
    yaml = written(tmp_path, WRITERS["nav2 map_saver, slam_toolbox"][1], b"P5 3 1 255\n" + bytes([0, 205, 200]))
    assert load_map(yaml).cells.tolist() == [[OCCUPIED, FREE, FREE]]


def test_a_map_that_somebody_drew_on_keeps_its_unknown(tmp_path: Path) -> None:
    row = bytes([0, 205, 254, 254, 205] * 20 + [255])  # a brush of white, at the end
    yaml = written(tmp_path, WRITERS["nav2 map_saver, slam_toolbox"][1], b"P5 101 1 255\n" + row)
    assert load_map(yaml).cells[0, :5].tolist() == [OCCUPIED, UNKNOWN, FREE, FREE, UNKNOWN]


def test_images_of_every_depth_read_the_same(tmp_path: Path) -> None:
    shades = np.array([[0, 205, 254], [254, 0, 205]], np.uint8)
    gray16 = shades.astype(np.uint16) * 257
    opaque = np.dstack([shades, shades, shades, np.full_like(shades, 255)])
    images = {
        "p5.pgm": encode_pgm(shades),
        "commented.pgm": b"P5\n# CREATOR: map_saver.cpp 0.050 m/pix\n3 2\n255\n" + shades.tobytes(),
        "p2.pgm": b"P2\n# plain\n3 2\n255\n0 205 254\n254 0 205\n",
        "p5-16.pgm": b"P5 3 2 65535\n" + gray16.astype(">u2").tobytes(),
        "p5-127.pgm": b"P5 3 2 127\n" + np.rint(shades * (127 / 255)).astype(np.uint8).tobytes(),
        "gray.png": cv2.imencode(".png", shades)[1].tobytes(),
        "gray16.png": cv2.imencode(".png", gray16)[1].tobytes(),
        "opaque.png": cv2.imencode(".png", opaque)[1].tobytes(),
        "colour.png": cv2.imencode(".png", opaque[:, :, :3])[1].tobytes(),
    }
    for name, data in images.items():
        (tmp_path / name).write_bytes(data)
        yaml = written(tmp_path, YAML.replace("map.pgm", name))
        assert load_map(yaml).cells.tolist() == [[FREE, OCCUPIED, UNKNOWN], [OCCUPIED, UNKNOWN, FREE]], name


@pytest.mark.parametrize("mode", ["scale", "trinary"])
def test_a_transparent_pixel_is_unknown(mode: str, tmp_path: Path) -> None:
    pixels = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [254, 254, 254, 255]]], np.uint8)
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    yaml = written(tmp_path, YAML.replace("map.pgm", "a.png") + f"mode: {mode}\n")
    assert load_map(yaml).cells.tolist() == [[OCCUPIED, UNKNOWN, FREE]]


def test_yaml_as_other_tools_write_it(tmp_path: Path) -> None:
    dumped = (
        "\ufeff%YAML 1.1\n---\n"
        "free_thresh: 0.196\r\nimage: 'map.pgm'  # beside\nnegate: false\nmode: trinary\noccupied_thresh: 0.65\n"
        "origin:\n- -1.5\n- 2.25\n- 1.0e-1\nresolution: 0.05000000074505806\nsomebody:\n  elses:\n    - key\nlist: [a, b]\n...\n"
    )
    grid = load_map(written(tmp_path, dumped))
    assert grid.origin == SE2(-1.5, 2.25, 0.1)
    assert grid.cells.tolist() == [[OCCUPIED, UNKNOWN, FREE]]


@pytest.mark.parametrize(
    "data",
    [
        YAML.encode("utf-16"),
        ("\ufeff" + YAML).encode("utf-16-be"),
        ("# B\u00fcro\n" + YAML).encode("latin-1"),
        YAML.replace("[-1.5, 2.25, 0.1]", "[-1.5,  # x\n  2.25,\n  0.1]").encode(),
        (YAML + 'mode: "Trinary"\n').encode(),
        YAML.replace(": ", ":\t").replace("0.05", "5e-2").encode(),
    ],
)
def test_yaml_as_windows_and_people_write_it(data: bytes, tmp_path: Path) -> None:
    written(tmp_path, "").write_bytes(data)
    grid = load_map(tmp_path / "map.yaml")
    assert (grid.resolution_m, grid.origin) == (0.05, SE2(-1.5, 2.25, 0.1))
    assert grid.cells.tolist() == [[OCCUPIED, UNKNOWN, FREE]]


@pytest.mark.parametrize("image", ["/home/ann/maps/map.pgm", "C:\\maps\\map.pgm", "maps/map.pgm", "~/of-ann/map.pgm"])
def test_a_map_that_was_copied_says_where_its_image_is(image: str, tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"No such file or directory; map\.pgm lies beside it: write image: map\.pgm"):
        load_map(written(tmp_path, YAML.replace("map.pgm", image)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("image: map.pgm", "Image: map.pgm"), "'image' is missing; saw 'Image': keys are in lower case"),
        (("0.1]", "90]"), "origin: yaw in radians: expected a number from -6.28319 to 6.28319, saw '90'"),
        (("image: map.pgm", "image: none.pgm"), "none.pgm: No such file"),
        (("image: map.pgm\n", ""), "'image' is missing"),
        (("image: map.pgm", "image:"), "image: expected a file name"),
        (("0.05", "0"), "resolution: expected a number from 0.001 to 10, saw '0'"),
        (("0.05", "nan"), "resolution: expected a number"),
        (("0.05", "[1]"), "resolution: expected a number"),
        (("[-1.5, 2.25, 0.1]", "[1]"), "origin: expected [x, y, yaw]"),
        (("[-1.5, 2.25, 0.1]", "[1, inf, 0]"), "origin: expected a number"),
        (("[-1.5, 2.25, 0.1]", "[1, 2, 3"), "line 3: expected a list"),
        (("negate: 0", "negate: 7"), "negate: expected 0 or 1"),
        (("negate: 0", "mode: colour"), "mode: expected one of trinary, scale, raw"),
        (("0.65", "0.1"), "free_thresh 0.196 must be below occupied_thresh 0.1"),
        (("negate: 0", "&a b c"), "line 4: expected 'key: value'"),
        (("negate: 0", "negate: !!python/object x"), "only plain values"),
        (("negate: 0", "image: b.pgm"), "'image' is given twice"),
        (("map.pgm", "'map.pgm"), "the quote is not closed"),
        (("map.pgm", "map\0.pgm"), "embedded null"),
    ],
)
def test_a_broken_yaml_says_what_is_wrong(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    yaml = written(tmp_path, YAML.replace(*change, 1))
    with pytest.raises(MapFileError) as caught:
        load_map(yaml)
    assert said in str(caught.value)
    assert str(yaml) in str(caught.value)


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (b"", "an empty file"),
        (b"\xff\xd8\xff\xe0 a photograph", "convert it"),
        (b"P5 3 2", "no PGM header"),
        (b"P5 3 2 255\n12345", "cut short: 5 of 3x2 pixels"),
        (b"P2 3 1 255\n1 2 x", "cut short: 0 of 3x1"),
        (b"P5 0 2 255\n", "0x2 pixels; maps of 1 to"),
        (b"P5 30000 30000 255\n", "30000x30000 pixels"),
        (b"P5 3 2 70000\n", "PGM maximum 70000"),
        (b"\x89PNG\r\n\x1a\n", "a PNG without its header"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + struct.pack(">II", 3, 2) + b"\x08\0\0\0\0" + bytes(9), "without its end"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + struct.pack(">II", 3, 2) + bytes(14) + b"IEND", "cannot be decoded"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + struct.pack(">II", 30000, 30000) + b"\x08\0\0\0\0" + bytes(9), "30000x30000"),
    ],
)
def test_a_broken_image_says_what_is_wrong(image: bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(MapFileError) as caught:
        load_map(written(tmp_path, YAML, image))
    assert said in str(caught.value)


def test_the_image_in_place_of_its_yaml_is_recognised(tmp_path: Path) -> None:
    written(tmp_path, YAML)
    with pytest.raises(MapFileError, match=r"give the \.yaml file that names the image"):
        load_map(tmp_path / "map.pgm")
    with pytest.raises(MapFileError, match="No such file"):
        load_map(tmp_path / "none.yaml")


def test_a_bomb_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    side = math.isqrt(MAX_PIXELS) + 1
    yaml = written(tmp_path, YAML, b"P5 %d %d 255\n" % (side, side))
    tracemalloc.start()
    with pytest.raises(MapFileError):
        load_map(yaml)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@given(st.binary(max_size=300))
def test_any_bytes_are_a_map_or_an_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    folder = tmp_path_factory.mktemp("any")
    for prefix in (b"", b"P5 2 2 255\n", b"P2 2 2 255\n"):
        with _maybe():
            load_map(written(folder, YAML, prefix + data))
    (folder / "map.yaml").write_bytes(YAML.encode() + data)
    with _maybe():
        load_map(folder / "map.yaml")


@given(st.text(max_size=200))
def test_any_text_is_flat_yaml_or_its_error(text: str) -> None:
    try:
        values = parse_flat_yaml(text)
    except FlatYamlError:
        return
    assert all(isinstance(key, str) for key in values)


class _maybe:
    """Passes a MapFileError, and nothing else, over."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        return kind is not None and issubclass(kind, MapFileError)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    yaml, pgm = save_map(OccupancyGrid(CELLS, 0.05), tmp_path / "map")
    before = pgm.read_bytes(), yaml.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_map(OccupancyGrid(CELLS[::-1], 0.1), tmp_path / "map")
    assert (pgm.read_bytes(), yaml.read_bytes()) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.pgm", "map.yaml"]


def test_an_image_that_never_ends_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("image: /dev/zero\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(MapFileError, match="a device or a pipe"):
        load_map(tmp_path / "a.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(MapFileError, match="a device or a pipe"):
        load_map(tmp_path / "pipe.yaml")
