"""Draw the frozen test sets of the embedded CAD shapes; done once, the files are committed.

python tools/save_test_sets.py
"""

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import CAD_FOLDER, CAD_VARIANTS, save_test_set
from dbdnet_jax.data.test_pairs import TEST_SEED

PAIRS = 200


def main() -> None:
    """Write one file per variant and print its hash."""
    CAD_FOLDER.mkdir(exist_ok=True)
    for variant, (protocol, half) in CAD_VARIANTS.items():
        path = CAD_FOLDER / f"cad_test_{variant}.npz"
        digest = save_test_set(path, cad_split("test", half), protocol, seed=TEST_SEED, count=PAIRS)
        print(f"{path.name}  sha256 {digest}")


if __name__ == "__main__":
    main()
