"""Build the embedded CAD set from Sweet Home 3D's furniture libraries.

Command: ``python tools/build_cad.py --archives /usr/share/sweethome3d/furniture
--classes tools/cad_classes.json --out dbdnet_jax/data/cad.npz`` (about 40 s on one core).
The archives are the five ``.sh3f`` files of the Debian package ``sweethome3d-furniture``.

Every model becomes 2048 evenly spaced points with face normals, normalised as ModelNet40. A model's
points depend on its own key ``library|path`` only, so a second run gives identical arrays (and,
with the same zlib, an identical file). Beside the npz the script writes ``CAD_ATTRIBUTION.md``.
"""

import argparse
import hashlib
import json
import zipfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from cad_archives import Library, Model, parse_obj, read_library
from jaxtyping import Float

from dbdnet_jax.data.surface import KEPT, even_points

POINT_SCALE = 32767  # int16 at the largest norm 1: a step of 3e-5
NORMAL_SCALE = 127  # int8: a step of 0.5 degrees


def sample_model(
    text: str, rotation: Float[np.ndarray, "3 3"] | None, key: str
) -> tuple[np.ndarray, np.ndarray]:
    """Points (2048, 3) int16 and normals (2048, 3) int8 of one OBJ file.

    The centroid of the points is the origin and the largest norm 1, before the rounding.
    """
    vertices, triangles = parse_obj(text)
    if rotation is not None:
        vertices = (vertices[:, None, :] * rotation).sum(-1)
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:16], "big")
    rng = np.random.Generator(np.random.PCG64(seed))
    points, normals = even_points(vertices, triangles, rng)
    return (
        np.rint(points * POINT_SCALE).astype(np.int16),
        np.rint(normals * NORMAL_SCALE).astype(np.int8),
    )


def check_keys(found: set[str], expected: set[str]) -> None:
    """Raise ValueError unless the archives hold exactly the models of the classes file."""
    if found == expected:
        return
    missing, extra = sorted(expected - found), sorted(found - expected)
    raise ValueError(
        f"the archives must hold exactly the {len(expected)} models of the classes file; "
        f"{len(missing)} are missing {missing[:3]}, {len(extra)} are unknown {extra[:3]}. "
        "Use the five archives of Debian's sweethome3d-furniture 1.8."
    )


def build(archives: Path, classes: Path) -> tuple[dict[str, np.ndarray], list[Library]]:
    """All arrays of the npz, models sorted by key, and the libraries they come from.

    Raises:
        ValueError: the archives do not hold exactly the models of the classes file.
    """
    table = json.loads(classes.read_text(encoding="utf-8"))
    class_of, half_of_class = table["class_of"], table["half_of_class"]
    files = {file.stem: file for file in sorted(archives.glob("*.sh3f"))}
    libraries = []
    for name, file in files.items():
        with zipfile.ZipFile(file) as archive:
            libraries.append(read_library(archive, name))
    models = {model.key: model for library in libraries for model in library.models}
    check_keys(set(models), set(class_of))

    keys = sorted(models)
    samples = {}
    for library in libraries:
        with zipfile.ZipFile(files[library.name]) as archive:
            for model in library.models:
                text = archive.read(model.path.lstrip("/")).decode("latin-1")
                samples[model.key] = sample_model(text, model.rotation, model.key)
        print(f"{library.name}: {len(library.models)} models", flush=True)
    points = np.stack([samples[key][0] for key in keys])
    arrays = {
        "points": points.transpose(0, 2, 1),  # (s, 3, n): compresses 2 % better
        "normals": np.stack([samples[key][1] for key in keys]),
        "label": np.array([class_of[key] for key in keys]),
        "half": np.array([half_of_class[class_of[key]] for key in keys]),
    }
    texts = [field for field in Model._fields if field != "rotation"]
    arrays |= {field: np.array([getattr(models[key], field) for key in keys]) for field in texts}
    return arrays, libraries


def attribution(libraries: list[Library]) -> str:
    """The text of CAD_ATTRIBUTION.md: licence, provider, creators and their models by library."""
    total = sum(len(library.models) for library in libraries)
    lines = [
        "# Where the embedded CAD shapes come from",
        "",
        f"`cad.npz` holds point clouds of {total} models from the furniture libraries of [Sweet "
        "Home 3D](https://www.sweethome3d.com), cleaned and converted to OBJ by Emmanuel Puybaret "
        f"/ eTeks. **Changed here:** each model is sampled to {KEPT} surface points with face "
        "normals, centred, scaled to the unit sphere and rounded; colours, textures and meshes "
        "are left out. The creators do not endorse this package. Written by `tools/build_cad.py`.",
        "",
        "A number after a name is the model's page, `http://www.blendswap.com/blends/view/NUMBER`.",
    ]
    for library in libraries:
        licence = f"[{library.licence}]({library.licence_url})"
        facts = [f"Licence: {licence}.", *(f"{notice}." for notice in library.notices)]
        facts += [f"Provider: {library.provider}.", f"{len(library.models)} models."]
        lines += ["", f"## {library.name}", "", " ".join(facts), ""]
        by_creator: dict[str, list[str]] = defaultdict(list)
        for model in library.models:
            by_creator[model.creator].append(_credit(model, library))
        for creator in sorted(by_creator, key=str.casefold):
            lines.append(f"- **{creator}**: {', '.join(_counted(by_creator[creator]))}")
    return "\n".join(lines) + "\n"


def _credit(model: Model, library: Library) -> str:
    number = model.source_url.rpartition("/")[2]
    licence = model.licence if model.licence != library.licence else ""
    notes = ", ".join(note for note in (number, licence) if note)
    return f"{model.name} ({notes})" if notes else model.name


def _counted(names: list[str]) -> list[str]:
    counts = Counter(names)
    return [f"{name} x {counts[name]}" if counts[name] > 1 else name for name in sorted(counts)]


def main() -> None:
    """Read the archives, write the npz and CAD_ATTRIBUTION.md, print the npz's sha256."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--archives", type=Path, required=True, help="folder of the .sh3f files")
    parser.add_argument("--classes", type=Path, required=True, help="cad_classes.json")
    parser.add_argument("--out", type=Path, required=True, help="the npz to write")
    arguments = parser.parse_args()
    arrays, libraries = build(arguments.archives, arguments.classes)
    np.savez_compressed(arguments.out, **arrays)
    notes = arguments.out.with_name("CAD_ATTRIBUTION.md")
    notes.write_text(attribution(libraries), encoding="utf-8")
    data = arguments.out.read_bytes()
    print(f"{arguments.out}: {len(data) / 1e6:.1f} MB, for dbdnet_jax/data/cad.py:")
    print(f'CAD_SHA256 = "{hashlib.sha256(data).hexdigest()}"')


if __name__ == "__main__":
    main()
