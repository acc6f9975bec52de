"""The paper's network with parts taken out: what each kind answers, and what it is made of."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from dbdnet_jax.alignment.align import _network
from dbdnet_jax.evaluation.methods import learned_methods
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.growing import with_local_geometry
from dbdnet_jax.networks.dbdnet.method import predict
from dbdnet_jax.networks.dbdnet.register import predict_overlap, register
from dbdnet_jax.networks.dbdnet.registration import RegistrationNetwork
from dbdnet_jax.networks.dbdnet.released import to_released
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import parameter_shapes, parts_of
from dbdnet_jax.networks.weights import load_params, save_params
from dbdnet_jax.types import Cloud
from tests.conftest import EXACT, FLOAT32, assert_close, assert_finite, random_cloud
from tests.ladder import LADDER, small_step

N, COUNTS = 40, (36, 31)
SEEN = 24  # of the points: the overlap of the others is interpolated
KINDS = ("dgcnn", "joint_overlap")  # each is compiled once


def params_of(name: str) -> Params:
    return init_params(jax.random.key(1), small_step(name, registration_points=SEEN, min_points=6))


@functools.cache
def answers(name: str) -> list:
    """The same clouds with zeros and with NaN in the rows that are no points."""
    program, params, found = jax.jit(register), params_of(name), []
    masks = [jnp.arange(N) < count for count in COUNTS]
    for garbage in (0.0, np.nan):
        clouds = [np.float32(random_cloud(seed, N)) for seed in (1, 2)]
        for cloud, mask in zip(clouds, masks, strict=True):
            cloud[~np.asarray(mask)] = garbage
        found.append(jax.device_get(program(params, *clouds, *masks)))
    return found


def test_the_ladder_takes_one_thing_of_the_network_away_at_a_time():
    models = [module.get_config().model.to_dict() for module in LADDER.values()]
    taken = [{k: v for k, v in model.items() if v != models[0][k]} for model in models]
    assert taken == [
        {},
        {"branches": 1},
        {"branches": 1, "overlap": "joint"},
        {"branches": 1, "overlap": "none"},
        {"branches": 1, "overlap": "none", "encoder": "dgcnn"},
    ]
    ours = ("overlap_matching", "overlap_passes", "local_geometry")
    assert all(models[0][name] == getattr(ModelConfig(), name) for name in ours)


@pytest.mark.parametrize("name", KINDS)
def test_one_branch_gives_both_and_all_is_finite(name):
    answer, _ = answers(name)
    assert_finite(answer)
    assert answer.valid
    assert_close(answer.rotation @ answer.rotation.T, np.eye(3), FLOAT32)
    for own, other in zip(answer.rotation_branch, answer.translation_branch, strict=True):
        assert_close(own, other, EXACT)


@pytest.mark.parametrize("name", KINDS)
def test_padding_changes_nothing(name):
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), *answers(name))


def test_without_an_overlap_all_points_that_are_seen_are_matched():
    answer, _ = answers("dgcnn")
    for overlap, kept, count in (
        (answer.src_overlap, answer.src_kept, COUNTS[0]),
        (answer.tgt_overlap, answer.tgt_kept, COUNTS[1]),
    ):
        assert_close(overlap, np.float32(np.arange(N) < count), EXACT)
        assert kept.sum() == SEEN and not kept[count:].any()


def test_a_joint_overlap_is_of_all_points_and_says_which_are_matched():
    answer, _ = answers("joint_overlap")
    matrix = answer.rotation_branch.correspondence
    sides = (
        (answer.src_overlap, answer.src_kept, COUNTS[0], matrix),
        (answer.tgt_overlap, answer.tgt_kept, COUNTS[1], matrix.T),
    )
    for overlap, kept, count, rows in sides:
        assert ((overlap[:count] > 0) & (overlap[:count] < 1)).all() and not overlap[count:].any()
        assert 6 <= kept.sum() <= SEEN
        assert not rows[~kept].any() and rows[kept].any(axis=1).all()
        if kept.sum() > 6:
            assert (overlap[kept] > 0.5).all()


def test_the_points_that_a_joint_overlap_takes_follow_its_threshold():
    params = params_of("joint_overlap")
    network, points = params.registration, np.float32([random_cloud(s, N) for s in (1, 2)])
    clouds = Cloud(jnp.asarray(points), jnp.asarray([N, COUNTS[1]]))
    features = jax.random.normal(jax.random.key(0), (2, N, 16))

    @jax.jit
    def match(threshold_logit):
        tree = {**network, "overlap_head": {**network["overlap_head"]}}
        linear = tree["overlap_head"]["linear"]
        tree["overlap_head"]["linear"] = {**linear, "bias": linear["bias"] - threshold_logit}
        return RegistrationNetwork(params.config).apply(
            {"params": tree}, clouds, features, method="match"
        )

    middle = float(np.median(match(0.0).overlap[0]))
    for shift, expected in ((middle, None), (1e3, 6)):
        found = match(shift)
        passing = np.asarray(found.overlap > 0) & np.asarray(clouds.valid)
        for matched, wanted in zip(np.asarray(found.matched), passing, strict=True):
            if expected is None and wanted.sum() >= 6:
                np.testing.assert_array_equal(matched, wanted)
            else:
                assert matched.sum() == 6
    assert not np.asarray(match(1e3).matched[1, COUNTS[1] :]).any()


@pytest.mark.parametrize("name", ["prior_overlap", "joint_overlap", "dgcnn"])
def test_the_list_of_parameters_is_what_initialising_makes(name):
    config = small_step(name)
    clouds = Cloud(jnp.zeros((2, 16, 3)), jnp.full((2,), 16))
    tree = jax.eval_shape(RegistrationNetwork(config).init, jax.random.key(0), clouds)["params"]
    made = {f"registration/{name}": x.shape for name, x in flatten_dict(tree, sep="/").items()}
    assert made == parameter_shapes(config, ("registration",))
    assert parts_of(config) == (("overlap",) if config.overlap == "prior" else ()) + (
        "registration",
    )


@pytest.mark.parametrize("name", LADDER)
def test_weights_survive_a_file_and_are_a_row_of_a_table(tmp_path, name):
    params = init_params(jax.random.key(0), small_step(name))
    save_params(tmp_path / "x.npz", params)
    loaded = load_params(tmp_path / "x.npz")
    assert loaded.config == params.config
    jax.tree.map(np.testing.assert_array_equal, loaded.networks, params.networks)
    rows = [row.name for row in learned_methods(loaded, "DBDNet", 0)]
    assert rows[:2] == ["DBDNet (untrained)", "DBDNet"]
    assert _network(loaded, 0.4).config.overlap_threshold == 0.4  # `align` takes them


@pytest.mark.parametrize(("name", "predicted"), [("dgcnn", False), ("joint_overlap", True)])
def test_an_overlap_that_is_not_predicted_is_not_answered(name, predicted):
    cloud = Cloud(jnp.zeros((N, 3)), jnp.asarray(N))
    answer = jax.eval_shape(predict, params_of(name), cloud, cloud)
    assert (answer.source_overlap is not None) == (answer.target_overlap is not None) == predicted
    with pytest.raises(ValueError, match="predict_overlap needs an overlap network.*Use register"):
        predict_overlap(params_of(name), cloud, cloud)


def test_a_dgcnn_grows_into_local_geometry_too():
    grown = with_local_geometry(params_of("dgcnn"), 1)
    found = {"/".join(k): x.shape for k, x in flatten_dict(grown.networks).items()}
    assert found == parameter_shapes(grown.config)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder": "pointnet"}, r"encoder must be one of \('multiresolution', 'dgcnn'\); got"),
        ({"overlap": "late"}, r"overlap must be one of \('prior', 'joint', 'none'\); got 'late'"),
        ({"branches": 3}, "branches must be from 1 to 2; got 3. Use 2"),
        ({"encoder": "dgcnn", "released": True}, "encoder must be 'multiresolution' where releas"),
        ({"branches": 1, "released": True}, "branches must be 2 where released=True.*got 1"),
        ({"overlap": "joint", "released": True}, "overlap must be 'prior' where released=True"),
        ({"overlap": "none", "overlap_matching": True}, "overlap_matching must be False unless"),
    ],
)
def test_what_cannot_be_built_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(small_step("dual_branches"), **changes)


def test_the_released_code_has_no_such_network():
    params = init_params(jax.random.key(0), small_step("prior_overlap"))
    with pytest.raises(ValueError, match="branches is 2 in the released code"):
        to_released(params)
