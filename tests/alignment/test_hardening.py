"""Bad and odd inputs at every door, each with its outcome; `test_hardening_files` has the files.

Nothing here may give a traceback from inside, a silent identity, or a half-written file.
"""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax import save_params
from dbdnet_jax.alignment.arguments import check_options
from dbdnet_jax.alignment.pose_programs import predict_pose
from dbdnet_jax.alignment.writing import write_ply
from dbdnet_jax.cli import main
from dbdnet_jax.cli.statuses import UNUSABLE
from tests.aligning import POINTS, pair, rotation_error_deg, solid, tiny_align, tiny_params
from tests.conftest import random_cloud

SOURCE, TARGET, TRUE = pair()
CLOUD = SOURCE[:40]


def with_entry(value: float) -> np.ndarray:
    points = CLOUD.copy()
    points[7, 1] = value
    return points


NO_CLOUDS = {
    "nan": (with_entry(np.nan), r"must be finite; 1 of 40 .* the first at row 7"),
    "infinity": (with_entry(np.inf), r"must be finite; 1 of 40 .*np\.isfinite|isfinite\(points\)"),
    "all nan": (np.full((40, 3), np.nan), r"must be finite; 40 of 40"),
    "too large to square": (with_entry(1e160), r"coordinates below 1e\+100; got 1e\+160"),
    "empty list": ([], r"must be \(n, 3\); got \(0,\)"),
    "no rows": (np.zeros((0, 3)), r"at least 16 points; got 0"),
    "one point": (CLOUD[:1], r"at least 16 points; got 1"),
    "fifteen points": (CLOUD[:15], r"at least 16 points; got 15. Give more"),
    "all equal": (np.ones((40, 3)), r"must hold different points; all 40 are \[1\. 1\. 1\.\]"),
    "equal but for rounding": (1e6 + 1e-9 * CLOUD, r"must hold different points"),
    "ten places": (np.repeat(CLOUD[:10], 9, axis=0), r"points at 16 places at least; got 10"),
    "columns as rows": (CLOUD.T, r"must be \(n, 3\); got \(3, 40\). .*give points\.T"),
    "two dimensions": (CLOUD[:, :2], r"got \(40, 2\). .*column of zeros"),
    "colours too": (np.hstack([CLOUD, CLOUD]), r"got \(40, 6\). .*points\[:, :3\]"),
    "homogeneous": (np.pad(CLOUD, ((0, 0), (0, 1))), r"got \(40, 4\). .*points\[:, :3\]"),
    "a batch": (CLOUD[None], r"got \(1, 40, 3\). Give one cloud at a time"),
    "flat": (CLOUD.ravel(), r"got \(120,\). Rows are points"),
    "a number": (3.0, r"must be \(n, 3\); got \(\)"),
    "none": (None, r"must hold real numbers; got dtype object \(NoneType\)"),
    "complex": (CLOUD + 0j, r"must hold real numbers; got dtype complex128"),
    "objects": (CLOUD.astype(object), r"must hold real numbers; got dtype object"),
    "words": (CLOUD.astype(str), r"must hold real numbers; got dtype <U"),
    "bytes": (b"points.ply", r"must hold real numbers; got dtype \|S10"),
    "booleans": (CLOUD > 0, r"must hold real numbers; got dtype bool"),
    "dates": (np.zeros((40, 3), "M8[s]"), r"must hold real numbers; got dtype datetime64"),
    "named columns": (np.zeros(40, [("x", "f4"), ("y", "f4")]), r"must hold real numbers"),
    "ragged": ([[1, 2, 3], [4, 5]] * 20, r"must be an \(n, 3\) array of numbers; got list"),
    "a dictionary": ({"points": CLOUD}, r"must hold real numbers; got dtype object \(dict\)"),
    "masked": (np.ma.masked_less(CLOUD, 0), r"must have no masked entries"),
}


@pytest.mark.parametrize("name", NO_CLOUDS)
@pytest.mark.parametrize("side", ["source", "target"])
def test_what_is_no_cloud_is_refused_by_name(name, side):
    bad, message = NO_CLOUDS[name]
    clouds = (bad, TARGET) if side == "source" else (SOURCE, bad)
    with pytest.raises(ValueError, match=message) as caught:
        tiny_align(*clouds)
    assert str(caught.value).startswith(f"{side} must")


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
BAD_ARGUMENTS = {
    "scale 0": ({"scale": 0.0}, r"scale must be 'auto' or a positive number; got 0"),
    "scale nan": ({"scale": np.nan}, r"scale must be 'auto' or a positive"),
    "scale beyond float32": ({"scale": 1e90}, r"size from 1e-6 to 1e6.*Use 'auto'"),
    "scale word": ({"scale": "big"}, r"got 'big'"),
    "threshold 2": ({"overlap_threshold": 2.0}, r"overlap_threshold must be in \[0, 1\); got 2"),
    "threshold nan": ({"overlap_threshold": np.nan}, r"overlap_threshold must be in"),
    "initial 3x3": ({"initial": np.eye(3)}, r"initial must be 4x4 and finite; got shape \(3, 3\)"),
    "initial nan": ({"initial": np.full((4, 4), np.nan)}, r"initial must be .*; it holds nan"),
    "any unrefined": ({"search": "any", "refine": False}, r"search must be 'auto' or 'near' with"),
    "initial scaled": ({"initial": 2 * np.eye(4)}, r"misses orthogonality by 3.* Remove scale"),
    "initial mirrored": ({"initial": MIRROR}, r"determinant -1\. Remove scale and reflection"),
    "initial transposed": ({"initial": TRUE.T}, r"last row of 0 0 0 1"),
    "initial words": ({"initial": "guess"}, r"initial must be a 4x4 array of numbers"),
}


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_a_bad_argument_is_refused(name):
    options, message = BAD_ARGUMENTS[name]
    with pytest.raises(ValueError, match=message):
        tiny_align(SOURCE, TARGET, **options)


def test_too_few_points_for_the_network_are_refused():
    from dbdnet_jax.alignment.align import align

    with pytest.raises(ValueError, match=r"at least 64; got 8"):
        align(SOURCE, TARGET, tiny_params(), max_points=8)


def test_half_a_network_is_refused():
    from dbdnet_jax.alignment.align import align

    half = tiny_params().replace(networks={"registration": tiny_params().registration})
    with pytest.raises(ValueError, match="both networks; got registration"):
        align(SOURCE, TARGET, half)


LINE = np.linspace(-1, 1, 200)[:, None] * [1.0, 2.0, 0.5]
PLANE = random_cloud(4, 200) * [1, 1, 0]
SANE = {  # source, target, part of the reason; None: an answer of whatever certainty
    "float16": (SOURCE.astype(np.float16), TARGET.astype(np.float16), None),
    "integers": ((1000 * SOURCE).astype(int), (1000 * TARGET).astype(int), None),
    "unsigned": (
        (99 * SOURCE + 300).astype(np.uint16),
        (99 * TARGET + 300).astype(np.uint16),
        None,
    ),
    "lists": (SOURCE.tolist(), TARGET.tolist(), None),
    "jax arrays": (jnp.asarray(SOURCE), jnp.asarray(TARGET), None),
    "backwards in memory": (SOURCE[::-1], np.asfortranarray(TARGET), None),
    "read-only": (np.broadcast_to(SOURCE, SOURCE.shape), TARGET, None),
    "identical": (SOURCE, SOURCE, None),
    "sixteen points": (SOURCE[:16], TARGET, None),
    "duplicates": (np.repeat(SOURCE, 5, axis=0), TARGET, None),
    "unit 1e-6": (1e-6 * SOURCE, 1e-6 * TARGET, None),
    "unit 1e9": (1e9 * SOURCE, 1e9 * TARGET, None),
    "at 1e9": (SOURCE + 1e9, TARGET - 1e9, None),
    "mirrored": (SOURCE * [1, 1, -1], TARGET, None),
    "noise": (random_cloud(1, 200), random_cloud(2, 200), None),
    "collinear": (LINE, LINE + 1, "lie on a line"),
    "a line and a shape": (SOURCE, 0.3 * LINE, "the target's points lie on a line"),
    "coplanar": (PLANE, random_cloud(5, 200) * [1, 1, 0], "the surfaces leave free: translation"),
    "ten times larger": (SOURCE, 10 * TARGET, "are both in the same unit?"),
    "a thousandth": (SOURCE, 0.001 * TARGET, "are both in the same unit?"),
}


@pytest.mark.parametrize("name", SANE)
def test_an_odd_pair_gets_a_sane_answer(name):
    source, target, reason = SANE[name]
    answer = tiny_align(source, target)
    rotation = answer.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.isfinite(answer.transform).all() and np.isfinite(answer.information).all()
    assert answer.source_overlap.shape == (len(source),)
    assert 0 <= answer.success_probability <= 1
    assert answer.valid == (answer.reason == "")
    if reason:
        assert reason in answer.reason


def test_a_stray_point_changes_little():
    strayed = np.vstack([SOURCE, [[1e5, 0, 0]]])
    answer = tiny_align(strayed, TARGET, initial=TRUE)
    assert rotation_error_deg(answer.transform, TRUE) < 2
    assert answer.warnings[0] == "1 points of the source, far from the rest, were left out"


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_the_network_itself_answers_nonsense_with_a_rotation(bad):
    source = solid(POINTS, 1)
    source[3] = bad
    answer = predict_pose(tiny_params(), source, solid(POINTS, 2))
    assert np.isfinite(answer.transform).all()
    assert abs(np.linalg.det(answer.transform[:3, :3]) - 1) < 1e-6


BAD_COMMANDS = {
    "one cloud": (["a.ply"], "give two clouds, or --batch"),
    "three clouds": (["a.ply"] * 3, "give two clouds, or --batch"),
    "clouds and a batch": (["a.ply", "a.ply", "--batch", "x"], "give two clouds, or --batch"),
    "nothing": ([], "give two clouds, or --batch"),
    "no such option": (["a.ply", "a.ply", "--refin3"], "unrecognized arguments: --refin3"),
    "no number": (["a.ply", "a.ply", "--seed", "x"], "--seed: must be a whole number from 0 to"),
    "negative seed": (["a.ply", "a.ply", "--seed", "-1"], "4294967295; got '-1'"),
    "threshold 1": (["a.ply", "a.ply", "--overlap-threshold", "1"], "from 0 to below 1; got '1'"),
    "eight points": (["a.ply", "a.ply", "--max-points", "8"], "from 64 to 65536; got '8'"),
    "huge scale": (["a.ply", "a.ply", "--scale", "1e300"], "from 1e-100 to 1e100; got '1e300'"),
    "scale beyond float32": (
        ["a.ply", "a.ply", "--scale", "1e90"],
        "--scale must bring the clouds",
    ),
    "option that is no text": (["a.ply", "a.ply", "--\x1b[2J"], "arguments: --\\x1b[2J"),
    "output is an input": (["a.ply", "b.ply", "--save-aligned", "half/../b.ply"], "is also b.ply"),
    "output is a link to one": (
        ["link.ply", "link.ply", "--save-aligned", "a.ply"],
        "an output must not replace an input",
    ),
    "output is the guess": (
        ["a.ply", "a.ply", "--initial", "three.txt", "-o", "three.txt"],
        "is also three.txt",
    ),
    "output is the batch": (["--batch", "list/0001_a_a.txt", "-o", "list"], "is also list/0001"),
    "no scale": (
        ["a.ply", "a.ply", "--scale", "x"],
        "auto, or a number from 1e-100 to 1e100; got 'x'",
    ),
    "missing input": (["a.ply", "no.ply"], "a point file must exist; no.ply does not"),
    "bad input": (["a.ply", "tiny.npz"], "it must hold one array, or one named 'points'"),
    "bad weights": (["a.ply", "a.ply", "--params", "bad.npz"], "was not written by save_params"),
    "no such weights": (["a.ply", "a.ply", "--params", "best"], "must be one of the weights in"),
    "no such guess": (["a.ply", "a.ply", "--initial", "x.txt"], "x.txt"),
    "bad guess": (["a.ply", "a.ply", "--initial", "a.ply"], "must hold 4x4 numbers"),
    "output ending": (
        ["a.ply", "a.ply", "-o", "t.xml"],
        "must be one of .txt .json .npy; got t.xml",
    ),
    "output folder": (["a.ply", "a.ply", "-o", "no/t.txt"], "folder of an output must exist; no"),
    "output is a folder": (["a.ply", "a.ply", "-o", "d.txt"], "must be a file; d.txt is a folder"),
    "no cloud to save": (["a.ply", "a.ply", "--save-aligned", "t.obj"], "must be one of .ply"),
    "empty batch": (["--batch", "empty.txt"], "must have at least one pair; empty.txt has none"),
    "batch of three": (["--batch", "three.txt"], "three.txt:1 must hold two paths; got 3"),
    "batch unquoted": (
        ["--batch", "quote.txt"],
        "quote.txt:1 must hold two paths; got 2: No closing",
    ),
    "no batch": (["--batch", "no.txt"], "no.txt"),
    "half a pair": (["--batch", "half"], "and one a_target.*; got 1 and 0. Rename"),
}


@pytest.mark.parametrize("name", BAD_COMMANDS)
def test_a_bad_command_is_status_2_and_one_line(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    write_ply(Path("a.ply"), SOURCE)
    save_params("tiny.npz", tiny_params())
    for text in ("empty", "three", "quote"):
        Path(f"{text}.txt").write_text({"empty": "#\n", "three": "a b c", "quote": "a 'b"}[text])
    Path("bad.npz").write_bytes(b"PK")
    Path("d.txt").mkdir()
    Path("half").mkdir()
    Path("list").mkdir()
    Path("list/0001_a_a.txt").write_text("../a.ply ../a.ply")
    write_ply(Path("b.ply"), TARGET)
    os.link("a.ply", "link.ply")
    write_ply(Path("half/a_source.ply"), SOURCE)
    before = sorted(Path().rglob("*"))
    arguments, message = BAD_COMMANDS[name]
    if "--params" not in arguments:
        arguments = [*arguments, "--params", "tiny.npz"]
    try:
        status = main(arguments)
    except SystemExit as exit_:  # argparse
        status = exit_.code
    out, err = capsys.readouterr()
    assert status == UNUSABLE
    assert message in err and not out and "Traceback" not in err
    assert sorted(Path().rglob("*")) == before


def test_points_that_stand_twice_change_nothing():
    twice = [np.repeat(cloud, 2, axis=0) for cloud in (SOURCE, TARGET)]
    once, again = tiny_align(SOURCE, TARGET, initial=TRUE), tiny_align(*twice, initial=TRUE)
    np.testing.assert_array_equal(again.transform, once.transform)
    assert again.inlier_distance == once.inlier_distance
    assert again.evidence == once.evidence and again.warnings == once.warnings
    np.testing.assert_array_equal(again.source_overlap, np.repeat(once.source_overlap, 2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": True}, "scale must be .* got True"),
        ({"overlap_threshold": "0.5"}, "overlap_threshold must be .* got '0.5'"),
        ({"max_points": 70.5}, "max_points must be a whole number .* got 70.5"),
    ],
)
def test_what_is_no_number_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        check_options(**options)


def test_numbers_of_numpy_are_numbers():
    options = {"scale": np.float32(2), "overlap_threshold": np.float32(0.5)}
    assert check_options(**options, max_points=np.int64(99), proposals=None) == (None, [])


def test_weights_of_another_method_are_refused_by_its_name():
    from dbdnet_jax.alignment.align import align
    from dbdnet_jax.networks.masknet.network import MaskNetConfig

    other = tiny_params().replace(networks={}, config=MaskNetConfig())
    with pytest.raises(ValueError, match="params must be weights of dbdnet; got those of masknet"):
        align(SOURCE, TARGET, other)
