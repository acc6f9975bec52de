"""Torch's names of FINet's parameters; no weights are public, so only the tests need them."""

from dbdnet_jax.networks.finet.network import FINetConfig
from dbdnet_jax.networks.torch_state import Entry, affine_entries
from tests.peers import chain_entries

LETTERS = {"rotation": "R", "translation": "t"}


def entries(config: FINetConfig) -> dict[str, Entry]:
    found: dict[str, Entry] = {}
    width = sum(config.encoder)
    fused, last = config.fusion[-1], config.regression[-1]
    clouds, sizes = {"rotation": 4, "translation": 3}, {"rotation": 4, "translation": 3}
    heads = {"rotation": "quaternion", "translation": "centre"}
    for i in range(config.turns):
        for branch, letter in LETTERS.items():
            block, fan_in = 0, 3
            for part, widths in enumerate(config.parts):
                numbers = range(block + 1, block + 1 + len(widths))
                names = [f"encoder.{i}.{letter}_block{j}" for j in numbers]
                ours = f"finet/turn_{i}/encoder/{branch}_{part}"
                theirs = [(f"{name}.0", f"{name}.1") for name in names]
                found |= chain_entries(ours, theirs, fan_in, widths, bias=False)
                block, fan_in = block + len(widths), 2 * widths[-1]
            names = [f"fusion.{i}.{letter}_block{j + 1}" for j in range(len(config.fusion))]
            theirs = [(f"{name}.0", f"{name}.1") for name in names]
            ours = f"finet/turn_{i}/fusion_{branch}"
            found |= chain_entries(ours, theirs, 2 * width, config.fusion, axes=0)
            net = f"regression.{i}.{letter}_net"
            layers = range(len(config.regression))
            theirs = [(f"{net}.{3 * j}", f"{net}.{3 * j + 1}") for j in layers]
            ours = f"finet/turn_{i}/regression_{branch}"
            wide = clouds[branch] * fused
            found |= chain_entries(ours, theirs, wide, config.regression, axes=0)
            ours = f"finet/turn_{i}/{heads[branch]}"
            found |= affine_entries(ours, f"{net}.{3 * len(layers)}", last, sizes[branch])
    return found
