"""A small 3DMatch folder in Predator's layout, written by hand: no torch, no real data."""

import io
import pickle
import zipfile

import numpy as np
from scipy.spatial.transform import Rotation

ADDRESS = "https://github.com/prs-eth/OverlapPredator"
SCENES = ("7-scenes-chess", "7-scenes-chess", "sun3d-lab.v2")
NUMBERS = ((0, 2), (3, 2), (10, 4))  # fragments of the three pairs; the second is consecutive


def torch_stream(array) -> bytes:
    """``array`` as ``torch.save`` wrote it before the zip format: five pickles in a row."""
    system = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}
    parts = (0x1950A86A20F9469CFC6C, 1001, system, array, [])
    return b"".join(pickle.dumps(part, protocol=2) for part in parts)


def torch_zip(array) -> bytes:
    """``array`` as ``torch.save`` writes it now."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("cloud/data.pkl", pickle.dumps(array, protocol=2))
        archive.writestr("cloud/byteorder", "little")
        archive.writestr("cloud/version", "3\n")
    return stream.getvalue()


def room(rng, count):
    """Points on the floor and two walls of a room of 3 m."""
    points = rng.uniform(0, 3, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0.0
    return points


def table_of_pairs(rng):
    """The info file's dict, without fragments."""
    return {
        "src": [f"train/{s}/cloud_bin_{n}.pth" for s, (n, _) in zip(SCENES, NUMBERS, strict=True)],
        "tgt": [f"train/{s}/cloud_bin_{n}.pth" for s, (_, n) in zip(SCENES, NUMBERS, strict=True)],
        "rot": [Rotation.random(rng=rng).as_matrix() for _ in SCENES],
        "trans": [rng.normal(size=(3, 1)) for _ in SCENES],
        "overlap": [0.3, 0.25, 0.4],
    }


def write_info(folder, name, table):
    (folder / name).write_bytes(pickle.dumps(table, protocol=3))


def write_folder(folder):
    """Three pairs of fragments of 800 to 1300 points; the source sees x < 2 m, the target x > 1."""
    rng = np.random.default_rng(0)
    table = table_of_pairs(rng)
    table["rot"][1], table["trans"][1] = np.eye(3), np.zeros((3, 1))  # its target is pair 0's
    target_pose = {}
    for i, (src, tgt) in enumerate(zip(table["src"], table["tgt"], strict=True)):
        rotation, translation = table["rot"][i], table["trans"][i].ravel()
        if i == 1:  # source 3 in the frame of the target written for pair 0
            rotation, translation = target_pose[tgt]
            source = room(rng, 1300) @ rotation.T + translation
        else:
            world = room(rng, 1300)
            source = world[world[:, 0] < 2]
            target = room(rng, 1300)
            target = target[target[:, 0] > 1] @ rotation.T + translation
            target_pose[tgt] = rotation, translation
            (folder / tgt).parent.mkdir(parents=True, exist_ok=True)
            (folder / tgt).write_bytes(torch_stream(target))
        (folder / src).write_bytes(torch_zip(source))
    write_info(folder, "train.pkl", table)


def closer_than(query, points, radius):
    """The labels by all distances."""
    return np.array([np.sqrt(((points - q) ** 2).sum(1)).min() < radius for q in query])
