"""Torch's names of INENet's parameters; no weights are public, so only the tests need them."""

from dbdnet_jax.networks.inenet.network import INENetConfig
from dbdnet_jax.networks.torch_state import Entry, affine_entries, batch_norm_entries
from tests.peers import chain_entries


def entries(config: INENetConfig) -> dict[str, Entry]:
    found: dict[str, Entry] = {}
    for part, theirs, width in (
        ("input", "stn", 3),
        ("feature", "emb_nn.stn", config.encoder[1]),
    ):
        ours = f"inenet/encoder/{part}"
        n = len(config.transform)
        names = [(f"{theirs}.conv{i + 1}", f"{theirs}.bn{i + 1}") for i in range(n)]
        found |= chain_entries(f"{ours}/points", names, width, config.transform)
        m = len(config.transform_head)
        names = [(f"{theirs}.fc{i + 1}", f"{theirs}.bn{n + i + 1}") for i in range(m)]
        head = config.transform_head
        found |= chain_entries(f"{ours}/cloud", names, config.transform[-1], head, axes=0)
        found |= affine_entries(f"{ours}/matrix", f"{theirs}.fc{m + 1}", head[-1], width**2)
    sizes = (3, *config.encoder)
    for i, (fan_in, width) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        names = f"emb_nn.conv{i + 1}", f"emb_nn.bn{i + 1}"
        ours = f"inenet/encoder/layer_{i}"
        found |= batch_norm_entries(ours, *names, fan_in, width, bias=False, axes=1)
    names = "emb_nn.conv5", "emb_nn.bn5"
    whole = sum(config.encoder)
    ours = "inenet/encoder/point"
    found |= batch_norm_entries(ours, *names, whole, config.features, bias=False, axes=1)
    for part, fan_in, widths, axes in (
        ("mask", config.points, config.mask, 1),
        ("threshold", config.features, config.threshold, 0),
    ):
        net = f"{part}_nn"
        names = [(f"{net}.{3 * i}", f"{net}.{3 * i + 1}") for i in range(len(widths))]
        found |= chain_entries(f"inenet/{part}", names, fan_in, widths, axes=axes)
        last = f"{net}.{3 * len(widths)}"
        found |= affine_entries(f"inenet/{part}_logit", last, widths[-1], 1, axes=axes)
    return found
