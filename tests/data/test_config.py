"""What a data set has not is refused by the field that asks for it."""

import pytest

from dbdnet_jax.data.config import DataConfig


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"categories": "Seen"}, "categories must be one of .*'unseen'.*; got 'Seen'"),
        ({"name": "threedmatch", "categories": "seen"}, "categories must be 'all' for 'three"),
        ({"stretch": 0.5}, r"stretch must be in \[1, 4\].*; got 0.5"),
        ({"name": "threedmatch", "stretch": 1.2}, "stretch must be .* 1 for 'threedmatch'"),
        ({"folder": "shapes"}, "folder must be '' for 'cad'.*; got 'shapes'. Leave it out"),
    ],
)
def test_what_a_data_set_has_not_is_refused(fields, message):
    with pytest.raises(ValueError, match=rf"config\.data\.{message}"):
        DataConfig(**fields)


@pytest.mark.parametrize("name", ["modelnet40", "threedmatch"])
def test_a_data_set_is_read_only_from_a_folder_that_was_given(name):
    DataConfig().require_folder()
    DataConfig(name, "somewhere").require_folder()
    with pytest.raises(ValueError, match=rf"config\.data\.folder must be where {name} stands"):
        DataConfig(name).require_folder()
