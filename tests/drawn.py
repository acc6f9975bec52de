"""An alignment made by hand, and what stands on a page: what tests of drawings share."""

import dataclasses
from html.parser import HTMLParser

import numpy as np

from dbdnet_jax.alignment.align import Alignment, Matches
from dbdnet_jax.alignment.success import PoseFeatures
from tests.aligning import pair

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&amp; $\\alpha{ caf\udce9.ply"
SOURCE, TARGET, TRUE = pair()
MATCHED = 100


def by_hand(**changes) -> Alignment:
    """A valid alignment of `SOURCE` and `TARGET` by the true motion, or with fields changed."""
    rng = np.random.default_rng(0)
    moved = SOURCE[:MATCHED] @ TRUE[:3, :3].T + TRUE[:3, 3]
    nearest = np.linalg.norm(moved[:, None] - TARGET, axis=2).argmin(axis=1)
    alignment = Alignment(
        transform=TRUE,
        valid=True,
        reason="",
        success_probability=1.0,
        warnings=(),
        inlier_ratio=1.0,
        inlier_distance=0.1,
        rmse=0.02,
        source_overlap=rng.uniform(size=len(SOURCE)),
        target_overlap=rng.uniform(size=len(TARGET)),
        matches=Matches(np.arange(MATCHED), nearest, np.linspace(1, 0, MATCHED)),
        information=np.eye(6),
        pivot=np.zeros(3),
        evidence=PoseFeatures(*np.zeros(len(PoseFeatures._fields))),
        timings={"network": 1.25, "refine": 0.5},
    )
    return dataclasses.replace(alignment, **changes)


class Reader(HTMLParser):
    """The elements of a page, and its text outside of scripts and styles."""

    def __init__(self, page: bytes):
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(page.decode())
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag, attributes):
        """Note what is opened, and what it may load."""
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("src", "href", "data")]
        assert not any(name.startswith("on") for name, _ in attributes)
        if tag != "meta":
            self._open.append(tag)

    def handle_endtag(self, tag):
        """Every element is closed in its turn."""
        assert self._open.pop() == tag

    def handle_data(self, data):
        """Gather the text."""
        if not {"script", "style"} & set(self._open):
            self.text += data
