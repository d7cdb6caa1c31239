"""What is drawn lands where it is in the cell, says how sure it is, and is not drawn when it is not sure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from docking.errors import FontMissing, OverlayUncertain
from docking.guidance import lettering
from docking.guidance.lettering import Letters
from docking.guidance.localiser import Localised
from docking.guidance.mesh import Mesh
from docking.guidance.overlay import COLOURS, draw
from docking.guidance.scene import Line, Mark, PartToPlace, Scene
from docking.guide_scene import overlay_texts
from docking.types import Pose
from sim.scenery import looking
from tests.support.guided_cell import CAMERA

X_WC = looking(np.array([0.0, 0.0, 0.0]), np.array([100.0, -50.0, 800.0]), 5.0)
GREY = np.full((480, 640), 128, np.uint8)


def found(position_sigma_mm: float = 0.5) -> Localised:
    cov = np.diag([1e-8, 1e-8, 1e-8, *[position_sigma_mm**2] * 3])
    return Localised(X_WC, cov, "map", 300, 400, 1.0, 800.0, 0.5, 0.0, CAMERA)


def scene(**parts: Any) -> Scene:
    empty: dict[str, Any] = {"lines": (), "marks": (), "parts": (), "head": (), "steps": ()}
    return Scene(anchor_mm=np.zeros(3), captions=overlay_texts("en"), **{**empty, **parts})


def drawn_at(image: np.ndarray, tone: str) -> np.ndarray:
    """Pixels (n, 2) x, y of one colour."""
    rows, columns = np.nonzero(np.all(image == COLOURS[tone], axis=2))  # type: ignore[index]
    return np.column_stack([columns, rows])


def test_a_mark_is_drawn_at_its_projection() -> None:
    at = np.array([120.0, 80.0, 30.0])
    image = draw(GREY, found(), scene(marks=(Mark(at, "", "bad"),)), 10.0)
    pixel = CAMERA.project(X_WC.inverse().apply(at))
    assert np.allclose(drawn_at(image, "bad").mean(axis=0), pixel, atol=0.8)


def test_a_vector_points_to_its_magnified_end() -> None:
    at, vector = np.array([0.0, 60.0, 0.0]), np.array([0.5, 0.0, 0.0])
    image = draw(GREY, found(), scene(marks=(Mark(at, "", "next", vector, 200.0, "move"),)), 10.0)
    tip = CAMERA.project(X_WC.inverse().apply(at + 200.0 * vector))
    assert np.min(np.linalg.norm(drawn_at(image, "next") - tip, axis=1)) < 2.5


def test_a_line_that_begins_behind_the_camera_is_not_drawn_across_the_picture() -> None:
    behind = X_WC.apply(np.array([[0.0, 0.0, -500.0], [0.0, 0.0, 900.0]]))
    draw(GREY, found(), scene(lines=(Line(behind, "good"),)), 10.0)
    sideways = X_WC.apply(np.array([[-4000.0, 0.0, -300.0], [300.0, 0.0, 800.0]]))
    image = draw(GREY, found(), scene(lines=(Line(sideways, "good"),)), 10.0)
    assert len(drawn_at(image, "good")) == 0 or drawn_at(image, "good")[:, 0].min() >= 0


def test_what_the_lens_model_would_fold_into_the_picture_is_not_drawn() -> None:
    lens = replace(CAMERA, k1=0.15, k2=-0.3)
    at = replace(found(), camera=lens, cov=np.eye(6) * 1e-12)
    beside = X_WC.apply(np.array([[1200.0, 0.0, 800.0]]))
    x, y = lens.to_pixels(np.array([1.5, 0.0]))
    assert 0.0 < x < 640.0
    assert 0.0 < y < 480.0
    image = draw(GREY, at, scene(marks=(Mark(beside[0], "", "bad"),)), 10.0)
    assert len(drawn_at(image, "bad")) == 0


def test_nothing_is_drawn_where_the_error_could_exceed_the_limit() -> None:
    good = scene(marks=(Mark(np.zeros(3), "", "good"),))
    draw(GREY, found(2.0), good, 10.0)
    with pytest.raises(OverlayUncertain) as refused:
        draw(GREY, found(6.0), good, 10.0)
    assert refused.value.value > 10.0
    with pytest.raises(OverlayUncertain):
        draw(GREY, found(float("nan")), good, 10.0)


def test_what_is_too_far_away_alone_is_left_out_and_counted() -> None:
    cov = np.diag([4e-6, 4e-6, 4e-6, 0.1, 0.1, 0.1])
    far = X_WC.apply(np.array([100.0, 50.0, 4000.0]))
    image = draw(GREY, replace(found(), cov=cov), scene(marks=(Mark(far, "", "bad"),)), 10.0)
    assert len(drawn_at(image, "bad")) == 0
    assert len(drawn_at(image, "close")) > 20  # the words that say so


def swinging() -> Localised:
    """Sure in the middle of the picture at 800 mm (0.7 mm), 10 mm off 1600 mm further away."""
    return replace(found(), cov=np.diag([4e-6, 4e-6, 4e-6, 0.1, 0.1, 0.1]))


def test_the_far_end_of_a_line_is_left_out_where_it_is_too_uncertain() -> None:
    near, far = np.array([0.0, 0.0, 600.0]), np.array([500.0, 0.0, 4600.0])
    image = draw(GREY, swinging(), scene(lines=(Line(X_WC.apply(np.array([near, far])), "good"),)), 10.0)
    drawn = drawn_at(image, "good")
    assert len(drawn) > 20
    depths = [600.0 + share * 4000.0 for share in np.linspace(0.0, 1.0, 400)]
    sure = [
        z for z in depths if swinging().predicted_error_mm(X_WC.apply(near + (z - 600.0) / 4000.0 * (far - near))) <= 10
    ]
    last = CAMERA.project(near + (max(sure) - 600.0) / 4000.0 * (far - near))
    assert drawn[:, 0].max() <= last[0] + 2.0
    assert len(drawn_at(image, "close")) > 20  # and that something was left out is said


def test_a_part_that_reaches_into_what_is_uncertain_is_named_and_not_drawn() -> None:
    points = np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 4000.0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3]])
    at = X_WC @ Pose(np.eye(3), np.array([0.0, 0.0, 700.0]))
    for reach, there in ((1.0, False), (0.01, True)):
        mesh = Mesh(points * (1.0, 1.0, reach), triangles)
        image = draw(GREY, swinging(), scene(parts=(PartToPlace("p", at, mesh, "next", ""),)), 10.0)
        named = draw(GREY, swinging(), scene(parts=(PartToPlace("p", at, mesh, "next", "bracket"),)), 10.0)
        assert (len(drawn_at(image, "next")) > 20) == there
        assert np.any(image != named)


def test_words_do_not_cover_each_other_and_those_in_the_margin_stay() -> None:
    black, colours = np.zeros((200, 300, 3), np.uint8), ((0, 0, 255), (0, 255, 0), (255, 0, 0))
    together = Letters(16)
    for k, colour in enumerate(colours):
        together.put(60.0 + 4.0 * k, 80.0 + 3.0 * k, "WWWWWWWW", colour, fixed=colour == colours[-1])
    image = together.drawn(black).astype(float)
    for k, colour in enumerate(colours):
        single = Letters(16)
        single.put(60.0 + 4.0 * k, 80.0 + 3.0 * k, "WWWWWWWW", colour)
        alone = single.drawn(black).astype(float)[:, :, 2 - k]
        assert image[:, :, 2 - k].sum() == pytest.approx(alone.sum(), rel=1e-6)
        assert np.array_equal(image[:, :, 2 - k], alone) == (k == 2)


def test_a_part_without_a_mesh_shows_its_axes() -> None:
    part = PartToPlace("bracket", Pose(np.eye(3), np.zeros(3)), None, "next", "")
    image = draw(GREY, found(), scene(parts=(part,)), 10.0)
    assert len(drawn_at(image, "next")) > 30


def test_every_picture_says_how_good_it_is() -> None:
    plain, worse = (draw(GREY, found(sigma), scene(), 10.0) for sigma in (0.5, 2.0))
    head = np.s_[:40, :600]
    assert np.any(plain[head] != 128)
    assert np.any(plain[head] != worse[head])


def test_chinese_words_are_drawn_or_the_missing_font_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    letters = Letters(20)
    letters.put(10, 10, "装配", (0, 0, 255))
    try:
        image = letters.drawn(np.zeros((60, 200, 3), np.uint8))
    except FontMissing:
        pytest.skip("no font with Chinese characters on this machine")
    boxes = Letters(20)
    boxes.put(10, 10, "配装", (0, 0, 255))
    # Two characters, not twice the box of a missing one.
    assert not np.array_equal(image, boxes.drawn(np.zeros((60, 200, 3), np.uint8)))
    monkeypatch.setattr(lettering, "FONTS", ())
    monkeypatch.delenv("DOCKING_FONT", raising=False)
    lettering.font.cache_clear()
    try:
        with pytest.raises(FontMissing):
            letters.drawn(np.zeros((60, 200, 3), np.uint8))
    finally:
        lettering.font.cache_clear()


def test_both_catalogues_have_the_same_keys_and_places() -> None:
    import re

    en, zh = overlay_texts("en"), overlay_texts("zh")
    assert en.keys() == zh.keys()
    for key, text in en.items():
        places = [sorted(set(re.findall(r"{(\w+)", t))) for t in (text, zh[key])]
        assert places[0] == places[1], key
