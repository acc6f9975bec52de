"""Pages and pictures of alignments: self-contained, whole, and safe from what files are called."""

import io
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

for library in ("plotly", "matplotlib", "jinja2"):
    pytest.importorskip(library, reason="the report extra is not installed")

from matplotlib.image import imread  # noqa: E402

from dbdnet_jax.alignment.align import Matches  # noqa: E402
from dbdnet_jax.drawing import style  # noqa: E402
from dbdnet_jax.drawing.alignment_page import alignment_page  # noqa: E402
from dbdnet_jax.drawing.picture import alignment_picture  # noqa: E402
from dbdnet_jax.drawing.selection import MATCHES_DRAWN, select_points  # noqa: E402
from dbdnet_jax.errors import MissingExtraError, require_drawing  # noqa: E402
from tests.drawn import HOSTILE, SOURCE, TARGET, TRUE, Reader, by_hand  # noqa: E402

NOWHERE = np.array([], int)
# Asks every figure, once all are there, for the names and sizes of what it shows.
ASK = b"""<script>
setInterval(() => document.querySelectorAll('[data-drawn]').forEach((plot) => {
  plot.dataset.traces = plot._fullData.filter((trace) => trace.visible === true)
    .map((trace) => trace.name + ' ' + trace.x.length).join(', ');
}), 100);
</script>
"""
ODD = {
    "unsure": {"valid": False, "reason": "the pose is right with a probability of only 0.2"},
    "no matches": {"matches": Matches(NOWHERE, NOWHERE, np.array([]))},
    "no inliers": {"valid": False, "reason": "free", "rmse": np.inf, "inlier_ratio": 0.0},
    "not finite": {"valid": False, "reason": "no pose", "transform": np.full((4, 4), np.nan)},
    "warned": {"warnings": ("low overlap: 7% < 30%", "a symmetric shape?")},
}


def share_of(picture: np.ndarray, colour: str) -> float:
    """Part of a picture's pixels that have nearly this colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return float((np.abs(picture[..., :3] - wanted).max(axis=-1) < 0.05).mean())


def coverage(picture: np.ndarray, colour: str) -> float:
    """Area of a colour, per area of the picture; edges that fade into white count as they cover.

    Mixing with white keeps the order of the channels and the ratio of their distances from white:
    dots of one or two pixels have no pixel of exactly their colour in some browsers.
    """
    ink = 1 - np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    missing = 1 - picture[..., :3]
    part = missing @ ink / (ink @ ink)
    pure = np.abs(missing - part[..., None] * ink).max(axis=-1) < 0.25 * part
    return float(np.clip(part, 0, 1)[pure & (part > 0.2)].sum() / part.size)


@pytest.mark.parametrize("faded", [1.0, 0.5])
def test_coverage_counts_faded_dots_of_the_colour_only(faded):
    orange, blue = (np.array(rgb) for rgb in ((0.902, 0.624, 0.0), (0.0, 0.447, 0.698)))
    picture = np.ones((10, 10, 3))
    picture[:2] = 1 - faded * (1 - orange)
    picture[2:6] = 1 - faded * (1 - blue)
    assert coverage(picture, style.SOURCE) == pytest.approx(0.2 * faded, rel=0.01)
    assert coverage(picture, style.TARGET) == pytest.approx(0.4 * faded, rel=0.01)


def test_a_page_holds_the_numbers_and_loads_nothing():
    command = "dbdnet-register a.ply 'b c.ply' --report out.html"
    page = alignment_page(by_hand(), SOURCE, TARGET, names=("a.ply", "b c.ply"), command=command)
    found = Reader(page)
    for piece in (
        "a.ply onto b c.ply: aligned", "Aligned", "100.0%", "0.02", f"{TRUE[0, 3]:.7g}", "380",
        "Before", "After", "Overlap", "60 most confident of the network's 100 matches",
        "Residuals", "1.75 s", command,
    ):  # fmt: skip
        assert piece in found.text
    assert not found.links and "link" not in found.tags
    assert b"default-src 'none'" in page
    assert found.tags.count("script") == 6  # the library and five figures


@pytest.mark.parametrize("name", ODD)
def test_odd_alignments_are_drawn_and_their_verdict_is_said(name):
    alignment = by_hand(**ODD[name])
    found = Reader(alignment_page(alignment, SOURCE, TARGET))
    assert ("Not aligned with confidence" in found.text) == (not alignment.valid)
    assert alignment.reason in found.text and all(x in found.text for x in alignment.warnings)
    picture = imread(io.BytesIO(alignment_picture(alignment, SOURCE, TARGET)))
    assert share_of(picture, style.GOOD if alignment.valid else style.BAD) > 5e-4


@pytest.mark.parametrize("unit", [1e-9, 1e9, 1e60])
@pytest.mark.parametrize("flat", [False, True])
def test_any_unit_and_flat_clouds_are_drawn(unit, flat):
    source = SOURCE * unit * [1, 1, not flat]
    alignment = by_hand(transform=np.eye(4), inlier_distance=0.1 * unit)
    page, picture = (
        draw(alignment, source, source) for draw in (alignment_page, alignment_picture)
    )
    assert "Aligned" in Reader(page).text
    assert share_of(imread(io.BytesIO(picture)), style.TARGET) > 1e-3


def test_names_do_not_break_out():
    plain = Reader(alignment_page(by_hand(), SOURCE, TARGET, names=("a", "b"), command="c"))
    found = Reader(
        alignment_page(by_hand(), SOURCE, TARGET, names=(HOSTILE, HOSTILE), command=HOSTILE)
    )
    assert found.tags == plain.tags
    assert found.text.count(HOSTILE.replace("\udce9", "\\udce9")) == 7
    picture = alignment_picture(by_hand(), SOURCE, TARGET, names=(HOSTILE, HOSTILE * 9))
    assert picture.startswith(b"\x89PNG")


def test_a_picture_has_its_size_and_both_clouds():
    picture = imread(io.BytesIO(alignment_picture(by_hand(), SOURCE, TARGET)))
    assert picture.shape[:2] == (560, 1500)
    assert share_of(picture, style.SOURCE) > 0.003 and share_of(picture, style.TARGET) > 0.003
    assert share_of(picture, "#FFFFFF") > 0.5


def test_distances_and_agreement_are_those_of_the_pose():
    drawn = select_points(by_hand(), SOURCE, TARGET)
    moved = SOURCE @ TRUE[:3, :3].T + TRUE[:3, 3]
    distances = np.linalg.norm(moved[:, None] - TARGET, axis=2).min(axis=1)
    apart, rows = cKDTree(SOURCE).query(drawn.before + drawn.origin)
    assert apart.max() < 1e-12 and sorted(rows) == list(range(len(SOURCE)))
    np.testing.assert_allclose(drawn.distance, distances[rows], atol=1e-12)
    np.testing.assert_array_equal(drawn.agrees, distances[:MATCHES_DRAWN] <= 0.1)
    assert cKDTree(TARGET).query(drawn.target + drawn.origin)[0].max() < 1e-12
    assert not drawn.apart


def test_clouds_far_apart_are_drawn_about_their_own_middles():
    far = TRUE.copy()
    far[:3, 3] += 1e6
    drawn = select_points(by_hand(transform=far), SOURCE, TARGET + 1e6)
    assert drawn.apart and max(np.abs(drawn.before).max(), np.abs(drawn.target).max()) < 2
    assert drawn.distance.max() < 0.3


def test_a_large_cloud_is_thinned_and_the_page_says_so():
    rng = np.random.default_rng(0)
    many = np.concatenate([SOURCE + rng.normal(0, 0.02, SOURCE.shape) for _ in range(50)])
    alignment = by_hand(source_overlap=np.zeros(len(many)))
    drawn = len(select_points(alignment, many, TARGET).after)
    assert 2000 < drawn <= 10_000
    text = Reader(alignment_page(alignment, many, TARGET)).text
    assert f"19,000{drawn:,}" in text and "an even choice of a large one" in text


@pytest.mark.parametrize("missing", ["plotly", "matplotlib", "jinja2"])
def test_a_missing_library_is_named_with_what_to_install(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=rf"{missing}.*pip install \"dbdnet_jax\[report\]"):
        require_drawing()


def test_a_browser_draws_the_page_without_a_complaint(tmp_path):
    names = "chromium", "chromium-browser", "google-chrome"
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is installed")
    names = HOSTILE, HOSTILE
    page = alignment_page(by_hand(), SOURCE, TARGET, names=names, command=HOSTILE)
    (tmp_path / "page.html").write_bytes(page.replace(b"</body>", ASK + b"</body>"))
    done = subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--enable-unsafe-swiftshader",
            "--enable-logging=stderr", "--virtual-time-budget=10000", "--window-size=1200,1400",
            f"--user-data-dir={tmp_path}/profile", f"--screenshot={tmp_path}/page.png",
            "--dump-dom", (tmp_path / "page.html").as_uri(),
        ],
        capture_output=True, text=True, timeout=300, env=os.environ | {"HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.stdout.count('data-drawn="yes"') == 5
    both = f"source {len(SOURCE)}, target {len(TARGET)}"
    matched = "agrees with the pose 180"  # two ends and a gap for each of 60 lines
    told = re.findall('data-traces="(.*?)"', done.stdout)
    assert told == [both, both, both, f"{both}, {matched}", "inliers 8, farther 32"]
    said = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    known = "GL Driver Message", "willReadFrequently"  # of drawing in software, and of speed
    assert not [line for line in said if not any(word in line for word in known)]
    picture = imread(tmp_path / "page.png")
    assert coverage(picture, style.SOURCE) > 0.001 and coverage(picture, style.TARGET) > 0.001
