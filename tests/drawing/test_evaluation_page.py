"""The page about an evaluation: figures of every method, pairs, and what was swept."""

import jax
import numpy as np
import pytest

pytest.importorskip("plotly", reason="the report extra is not installed")

from dbdnet_jax.classical import open3d as classical
from dbdnet_jax.drawing.evaluation_page import evaluation_page, network_row
from dbdnet_jax.evaluation.methods import Method, Traits, from_points
from dbdnet_jax.evaluation.run import Evaluation, Row, constant_overlap, evaluate_method
from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Answer, Cloud, Pair
from tests.drawn import HOSTILE, Reader

PAIRS, ROWS, COUNT = 5, 40, 32
HEAD = "vary,value,method,error_r,error_t,median_r,recall,seconds\n"


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    """The identity, and a "network" that is off by more degrees from pair to pair."""
    rng = np.random.default_rng(0)
    keys = jax.random.split(jax.random.key(1), PAIRS)
    motions = jax.device_get(jax.vmap(lambda key: rigid.random_rigid(key, 0.5, 0.5))(keys))
    points = rng.normal(size=(PAIRS, ROWS, 3)).astype(np.float32)
    target = np.einsum("pij,pnj->pni", motions.rotation, points) + motions.translation[:, None]
    label, count = np.ones((PAIRS, ROWS), bool), np.full(PAIRS, COUNT, np.int32)
    points[:, COUNT:] = np.nan  # padding is not drawn
    pairs = Pair(Cloud(points, count), Cloud(target, count), motions, label, label, points, points)
    degrees = iter([9, 0, 4, 1, 2, 3])  # the first call is for compilation

    def network(pair: Pair) -> Answer:
        angle = np.radians(next(degrees))
        turn = np.eye(3, dtype=np.float32)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        truth = pair.target_from_source
        return Answer(truth._replace(rotation=turn @ truth.rotation))

    return Evaluation(
        rows=[
            evaluate_method(Method("identity", from_points(classical.identity)), pairs),
            Row("ICP", note="install it"),
            evaluate_method(Method("DBDNet", network, Traits(learned=True)), pairs),
        ],
        constant_overlap=constant_overlap(pairs),
        pair_set="cad_test_noise",
        pairs=PAIRS,
        pairs_hash="a1b2c3",
        seed=7,
        command=f"python evaluate.py --params={HOSTILE}",
        device="cpu",
        test_pairs=pairs,
    )


def test_rows_keep_errors_and_motions(evaluation):
    row = network_row(evaluation)
    np.testing.assert_allclose(row.errors.rotation_deg, [0, 4, 1, 2, 3], atol=1e-3)
    assert row.motions.rotation.shape == (PAIRS, 3, 3)


def test_the_page_has_tables_charts_and_the_pairs_in_order(evaluation, tmp_path):
    found = Reader(evaluation_page(evaluation, tmp_path))
    for piece in (
        "5 pairs of cad_test_noise", "DBDNet: a median rotation error of", "geodesic", "a1b2c3",
        "ICP: install it", "Rotation errors", "Translation errors",
        "DBDNet, pair 0: off by", "pair 3: off by 2.00°", "DBDNet, pair 1: off by 4.00°",
        HOSTILE.replace("\udce9", "\\udce9"),
    ):  # fmt: skip
        assert piece in found.text
    assert found.text.index("pair 0:") < found.text.index("pair 3:") < found.text.index("pair 1:")
    assert found.tags.count("script") == 9 and not found.links  # the library and eight figures
    assert "Sweep" not in found.text


def test_a_saved_sweep_is_drawn_and_a_damaged_one_named(evaluation, tmp_path):
    name = HOSTILE.replace('"', '""').encode("ascii", "replace").decode()
    lines = "".join(f'noise,{x},"{name}",{y},0,0,0,0\n' for x, y in ((0, 4.5), (0.05, 17.25)))
    (tmp_path / "sweep_noise.csv").write_text(HEAD + lines)
    (tmp_path / "sweep_empty.csv").write_text(HEAD)
    (tmp_path / "sweep_words.csv").write_text(HEAD + "noise,much,ICP,1,1,1,1,1\n")
    (tmp_path / "sweep_other.csv").write_text("a,b\n1,2\n")
    page = evaluation_page(evaluation, tmp_path)
    found = Reader(page)
    assert found.tags.count("script") == 10
    assert b"standard deviation of the noise" in page and b"17.25" in page
    for name in ("empty", "words", "other"):
        assert f"sweep_{name}.csv could not be read" in found.text


def test_without_figures_the_page_says_so(evaluation, tmp_path):
    bare = evaluation._replace(rows=[Row("ICP", note="install it")], test_pairs=None)
    assert "No figures of the network." in Reader(evaluation_page(bare, tmp_path)).text
