"""Words of binary features: the tree sends like to like, and the bags find the key-frame."""

from __future__ import annotations

import numpy as np

from docking.guidance.features import extract
from docking.guidance.vocabulary import bags_of, train
from tests.support.guided_cell import guided_cell, picture, view


def test_a_few_flipped_bits_seldom_change_the_word() -> None:
    rng = np.random.default_rng(1)
    centres = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    given = np.repeat(centres, 12, axis=0)
    noisy = given ^ (rng.random((len(given), 32, 8)) < 0.02).dot(1 << np.arange(8)).astype(np.uint8)
    vocabulary = train(noisy)
    same = vocabulary.words(noisy) == vocabulary.words(given)
    assert np.mean(same) > 0.5
    # and unlike features do not all share one word
    assert len(np.unique(vocabulary.words(centres))) > 200


def test_the_same_descriptors_give_the_same_tree() -> None:
    given = np.random.default_rng(2).integers(0, 256, (2000, 32), dtype=np.uint8)
    a, b = train(given), train(given)
    assert all(np.array_equal(x, y) for x, y in zip(a.levels, b.levels, strict=True))


def test_the_key_frame_that_is_nearest_is_among_the_first() -> None:
    ar_map = guided_cell().ar_map
    frames = [f.descriptors for f in ar_map.keyframes]
    bags = bags_of(train(np.concatenate(frames)), frames)
    places = np.array([f.X_WC.t_mm for f in ar_map.keyframes])
    for x_mm in (30.0, 300.0, 600.0, 830.0):
        true = view(x_mm, 980.0, 820.0, 40.0)
        best = bags.alike(extract(picture(true)).descriptors, 5)
        assert min(np.linalg.norm(places[best] - true.t_mm, axis=1)) < 200.0
