"""Files of pictures: cameras, masks by colour, and tracked points."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from support.refusals import refuses
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.pictures.scene_files import (
    read_depth,
    read_mask,
    read_picture,
    read_scan,
    read_scene,
    read_tracked,
)
from warp_resphys.settings.pictures import ColourSettings

FRAME = {"image": "00.png", "time": 0.5, "world_to_camera": np.eye(4).tolist()}


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def picture(path):
    """A red body with a hole and a speck beside it, and a blue one."""
    image = np.full((60, 80, 3), 30, dtype=np.uint8)
    image[10:40, 10:40] = (200, 20, 40)
    image[20:25, 20:25] = 255
    image[50:52, 70:72] = (200, 20, 40)
    image[45:58, 45:60] = (20, 60, 220)
    Image.fromarray(image).save(path)
    return image


def test_cameras_and_masks_of_a_scene(tmp_path):
    picture(tmp_path / "00.png")
    content = {
        "frames": [FRAME, {**FRAME, "mask": "mask.png"}],
        "fixed": [{"vertices": [3, 1]}, {"vertices": [7]}],
    }
    scene = read_scene(write(tmp_path / "camera.json", content))
    assert [clamp.tolist() for clamp in scene.clamps] == [[3, 1], [7]]
    assert [frame.number for frame in scene.frames] == [0, 1]
    red = read_mask(scene.frames[0], ColourSettings(hue=(340.0, 10.0), saturation=0.5, value=0.3))
    assert red.sum() == 900  # with its hole, without the speck
    assert red[10:40, 10:40].all()
    given = np.zeros((60, 80), dtype=np.uint8)
    given[5:9, 5:9] = 1
    Image.fromarray(given).save(tmp_path / "mask.png")
    assert read_mask(scene.frames[1], None).sum() == 16
    clear = np.full((60, 80, 4), 255, dtype=np.uint8)
    clear[..., 3] = 255 * given
    Image.fromarray(clear).save(tmp_path / "mask.png")
    assert read_mask(scene.frames[1], None).sum() == 16
    with pytest.raises(InputError, match=r"00.png: no part has a hue from 100 to 140 degrees"):
        read_mask(scene.frames[0], ColourSettings(hue=(100.0, 140.0)))
    refuses(
        DataFileError, r"has no mask: name one in camera.json", read_mask, scene.frames[0], None
    )


def test_depth_images(tmp_path):
    """Integers have a unit, other numbers are metres."""
    deep = np.array([[0, 500], [65535, 1]], dtype=np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    np.save(tmp_path / "deep.npy", np.array([[0.25, np.nan]], dtype=np.float32))
    assert read_depth(tmp_path / "deep.png", 1e-3) == pytest.approx(1e-3 * deep)
    assert read_depth(tmp_path / "deep.png", 1e-4) == pytest.approx(1e-4 * deep)
    assert read_depth(tmp_path / "deep.npy", 1e-3)[0, 0] == 0.25
    picture(tmp_path / "00.png")
    with pytest.raises(DataFileError, match="has 8 bits: write depths as a PNG of 16-bit integers"):
        read_depth(tmp_path / "00.png", 1e-3)
    np.save(tmp_path / "flat.npy", np.zeros(3))
    refuses(DataFileError, "has one number at each pixel", read_depth, tmp_path / "flat.npy", 1e-3)
    refuses(DataFileError, "cannot read the depth image", read_depth, tmp_path / "none.png", 1e-3)


def test_scenes_with_depths_lenses_and_a_scan(tmp_path):
    moved = np.eye(4)
    moved[:3, 3] = (0.1, 0.0, 0.0)
    frames = [
        {**FRAME, "depth": "00_depth.png", "lens": "left"},
        {"depth": "01.npy", "lens": "right"},
    ]
    scene = read_scene(
        write(tmp_path / "camera.json", {"frames": frames, "world_to_cloud": moved.tolist()})
    )
    assert [frame.lens for frame in scene.frames] == ["left", "right"]
    assert scene.frames[0].depth == tmp_path / "00_depth.png"
    assert scene.frames[1].image == scene.frames[1].depth == tmp_path / "01.npy"
    assert scene.scan_pose[:3, 3].tolist() == [0.1, 0.0, 0.0]
    assert read_scene(tmp_path / "none.json", scanned=True).frames == ()
    write(tmp_path / "camera.json", {"world_to_cloud": [[1, 2], [3, 4]]})
    with pytest.raises(DataFileError, match=r"world_to_cloud is .* four lists of four numbers"):
        read_scene(tmp_path / "camera.json", scanned=True)


def points_of(path):
    """Points of a tetrahedron with a colour, in a format for each extension."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    header = (
        "# .PCD\nFIELDS rgb x y z\nSIZE 4 4 4 4\nTYPE U F F F\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT "
        "1\nPOINTS 4\n"
    )
    rows = np.column_stack([np.full(4, 7.0), points])
    if path.name == "ascii.pcd":
        path.write_text(
            header + "DATA ascii\n" + "\n".join(" ".join(f"{x:g}" for x in row) for row in rows)
        )
    elif path.name == "binary.pcd":
        kinds = [("rgb", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
        path.write_bytes(
            (header + "DATA binary\n").encode()
            + np.array([*map(tuple, rows)], dtype=kinds).tobytes()
        )
    elif path.suffix == ".npy":
        np.save(path, points)
    else:
        trimesh.PointCloud(points).export(path)
    return points


@pytest.mark.parametrize("name", ["ascii.pcd", "binary.pcd", "scan.npy", "scan.ply", "scan.xyz"])
def test_scans_of_points(tmp_path, name):
    expected = points_of(tmp_path / name)
    points, normals = read_scan((tmp_path / name).rename(tmp_path / name.upper()), 1e-3)
    assert points == pytest.approx(1e-3 * expected, abs=1e-9)
    assert normals is None


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_a_scanned_surface_has_points_on_its_triangles_and_outer_normals(tmp_path, suffix):
    trimesh.creation.icosphere(3, 40.0).export(tmp_path / f"scan{suffix}")
    points, normals = read_scan(tmp_path / f"scan{suffix}", 1e-3)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.04, rel=0.01)
    assert (points * normals).sum(1) == pytest.approx(0.04, rel=0.01)


def test_files_that_are_no_scans_are_said(tmp_path):
    (tmp_path / "scan.txt").write_text("0 0 0")
    (tmp_path / "scan.ply").write_text("nothing")
    (tmp_path / "packed.pcd").write_text(
        "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA binary_compressed\n"
    )
    np.save(tmp_path / "flat.npy", np.zeros((4, 2)))
    np.save(tmp_path / "empty.npy", np.full((4, 3), np.nan))
    for name, words in {
        "scan.txt": "its extension is none of .npy, .pcd, .ply",
        "scan.ply": "cannot read a scan from",
        "packed.pcd": "must be ascii or binary",
        "flat.npy": r"not \(points, 3\)",
        "empty.npy": "has no points",
        "none.ply": "there is no such file",
        "none.npy": "none.npy",
    }.items():
        refuses(DataFileError, words, read_scan, tmp_path / name, 1.0)


def test_a_turned_picture_is_read_as_it_is_seen(tmp_path):
    """Telephones write how they were held beside the picture."""
    image = picture(tmp_path / "00.png")
    exif = Image.Exif()
    exif[0x0112] = 6  # turned to the right
    Image.fromarray(image).save(tmp_path / "turned.png", exif=exif)
    assert (read_picture(tmp_path / "turned.png") == np.rot90(image, -1)).all()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "is no JSON"),
        ([1], "has no list 'frames'"),
        ({"frames": [{"time": 0.0}]}, "frame 0 has no 'image'"),
        ({"frames": [{**FRAME, "world_to_camera": [1, 2]}]}, r"frames\[0\].world_to_camera"),
        ({"frames": [FRAME], "fixed": [{"vertex": 1}]}, r"fixed\[0\].vertices is missing"),
        ({"frames": [FRAME], "fixed": [{"vertices": []}]}, r"fixed\[0\].vertices is \[\]"),
        (
            {"frames": [{**FRAME, "world_to_camera": np.diag([2, 2, 2, 1]).tolist()}]},
            "is no rotation with a shift",
        ),
    ],
)
def test_a_damaged_scene_is_named(tmp_path, content, sentence):
    refuses(DataFileError, sentence, read_scene, write(tmp_path / "camera.json", content))


def test_tracked_points_of_known_programs(tmp_path):
    wanted = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [np.nan, np.nan]]])
    heads = [
        "scorer,net,net,net,net,net,net",
        "bodyparts,tip,tip,tip,base,base,base",
        "coords,x,y,likelihood,x,y,likelihood",
    ]
    lines = [*heads, "0,3,4,0.9,1,2,1.0", "7,8,9,0.2,5,6,0.8"]
    table = write(tmp_path / "dlc.csv", "\n".join(lines))
    assert read_tracked(table, ["base", "tip"], 0.6, [0, 7]) == pytest.approx(wanted, nan_ok=True)
    plain = write(tmp_path / "plain.csv", "frame,base.x,base.y,tip.x,tip.y\n7,5,6,,\n0,1,2,3,4\n")
    assert read_tracked(plain, ["base", "tip"], 0.6, [0, 7]) == pytest.approx(wanted, nan_ok=True)
    tracks = np.nan_to_num(wanted)
    np.savez(tmp_path / "cotracker.npz", tracks=tracks, visibility=np.array([[1, 1], [1, 0]]))
    assert read_tracked(tmp_path / "cotracker.npz", ["base", "tip"], 0.6, [0, 1]) == pytest.approx(
        wanted, nan_ok=True
    )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("frame,base.x,base.y\n0,1,2\n", "no columns x and y of 'tip'"),
        ("base.x,base.y,tip.x,tip.y\n1,2,3,4\n", "its first column is 'base.x', not 'frame'"),
        ("frame,base.x,base.y,tip.x,tip.y\n0,1,2,3,4\n", "has no row of frame 1"),
        ("frame,base.x,base.y,tip.x,tip.y\n0,1,2\n", "cannot read tracked points"),
    ],
)
def test_a_damaged_table_is_named(tmp_path, text, sentence):
    refuses(
        DataFileError,
        sentence,
        read_tracked,
        write(tmp_path / "a.csv", text),
        ["base", "tip"],
        0.6,
        [0, 1],
    )


def test_tracks_of_another_shape_are_refused(tmp_path):
    refuses(
        DataFileError, "Cannot read", read_tracked, tmp_path / "missing.csv", ["base"], 0.6, [0]
    )
    for arrays in (
        {"tracks": np.zeros((4, 3, 2))},
        {"tracks": np.zeros((4, 2, 2)), "visibility": np.ones(4)},
    ):
        np.savez(tmp_path / "b.npz", **arrays)
        with pytest.raises(DataFileError, match="cannot read tracked points"):
            read_tracked(tmp_path / "b.npz", ["base", "tip"], 0.6, [0])
