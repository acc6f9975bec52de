"""Torch's names of OMNet's parameters; no weights are public, so only the tests need them."""

from dbdnet_jax.networks.omnet.network import CLASSES, OMNetConfig
from dbdnet_jax.networks.torch_state import Entry, affine_entries
from tests.peers import chain_entries


def entries(config: OMNetConfig) -> dict[str, Entry]:
    found: dict[str, Entry] = {}
    encoded, fused = config.encoder[-1], config.fusion[-1]
    both = 2 * (fused + sum(config.decoder))
    for i in range(config.turns):
        chains = [
            ("encoder", 3, config.encoder),
            ("fusion", config.encoder[config.kept - 1] + 2 * encoded, config.fusion),
            ("decoder", fused, config.decoder),
        ]
        for part, fan_in, widths in chains:
            blocks = [f"{part}.{i}.conv_block{j + 1}" for j in range(len(widths))]
            theirs = [(f"{block}.0", f"{block}.1") for block in blocks]
            found |= chain_entries(f"omnet/turn_{i}/{part}", theirs, fan_in, widths)
        last = f"decoder.{i}.conv_block{len(config.decoder) + 1}.0"
        name = f"omnet/turn_{i}/classes"
        found |= affine_entries(name, last, config.decoder[-1], CLASSES, axes=1)
        blocks = [f"regression.{i}.fc_block{j + 1}" for j in range(len(config.regression))]
        theirs = [(f"{block}.0", f"{block}.1") for block in blocks]
        name = f"omnet/turn_{i}/regression"
        found |= chain_entries(name, theirs, both, config.regression, axes=0)
        last = f"regression.{i}.final_fc.0"
        found |= affine_entries(f"omnet/turn_{i}/pose", last, config.regression[-1], 7)
    return found
