"""`docking fit` and its options, from the command line to the JSON object and the page."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.cli import call
from docking.geometry import pose_from_vector
from docking.pose import LASER_TRACKER
from docking.types import Array

J = np.random.default_rng(3).uniform([-4000, -2000, -2000], [4000, 2000, 2000], (10, 3))
VECTOR = [100.0, -200.0, 300.0, 1.0, -2.0, 30.0]
STATION = (0.0, -9000.0, 800.0)
NAMES = [f"T{i + 1}" for i in range(10)]
SIX = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


def seen(seed: int = 1) -> Array:
    p = pose_from_vector(VECTOR).apply(J)
    root = np.linalg.cholesky(LASER_TRACKER.covariance(p - np.array(STATION)))
    result: Array = p + np.einsum("nij,nj->ni", root, np.random.default_rng(seed).normal(size=p.shape))
    return result


def points(path: Path, xyz: Array, sigma: str = "") -> Path:
    head = "name,x_mm,y_mm,z_mm" + (",sx_mm,sy_mm,sz_mm" if sigma else "")
    rows = [f"{n},{x:.6f},{y:.6f},{z:.6f}{sigma}" for n, (x, y, z) in zip(NAMES, xyz, strict=True)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


Fitted = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Fitted:
    """Fit measured points to J with some options; the exit code and the JSON object."""

    def run(xyz: Array, *options: object, sigma: str = "", nominal: Array = J) -> tuple[int, dict[str, Any]]:
        files = points(tmp_path / "n.csv", nominal), points(tmp_path / "m.csv", xyz, sigma)
        code = call(["fit", *map(str, files), *map(str, options), "--json"])
        told: dict[str, Any] = json.loads(capsys.readouterr().out)
        return code, told

    return run


TRACKER = ("--noise", "tracker:0,-9000,800")


def test_the_default_is_maximum_likelihood_with_its_uncertainty(fitted: Fitted) -> None:
    code, told = fitted(seen(), *TRACKER)
    assert (code, told["method"], told["redundancy"], told["dof"], told["scale"]) == (0, "ml", 7, 24, 1.0)
    assert 0.001 < told["chi2_p"] < 0.999
    assert told["swapped"] == {}
    cov = np.array(told["covariance"])
    assert cov.shape == (6, 6)
    assert np.allclose(cov, cov.T, rtol=1e-6, atol=1e-18)
    assert np.all(np.linalg.eigvalsh(cov * np.outer(*[[3e3] * 3 + [1.0] * 3] * 2)) > 0.0)
    for key, true in zip(SIX, VECTOR, strict=True):
        assert abs(told["pose"][key] - true) < 4.5 * told["sigma"][key]


def test_covariance_and_sigma_are_what_happens(fitted: Fitted) -> None:
    """Over sixty draws the centroid's error by its covariance, and each number's by its sigma, are as said."""
    X, squares, ratios = pose_from_vector(VECTOR), [], []
    for seed in range(60):
        _, told = fitted(seen(seed), *TRACKER)
        if len(told["used"]) == 10:
            matrix, centre = np.array(told["pose"]["matrix"]), J.mean(axis=0)
            off = matrix[:3, :3] @ centre + matrix[:3, 3] - X.apply(centre)
            squares.append(off @ np.linalg.solve(np.array(told["covariance"])[3:, 3:], off))
            ratios.append([(told["pose"][k] - t) / told["sigma"][k] for k, t in zip(SIX, VECTOR, strict=True)])
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / len(squares)))
    assert np.mean(np.square(ratios), axis=0) == pytest.approx(np.ones(6), abs=4.0 * np.sqrt(2.0 / len(ratios)))


def test_the_covariance_is_about_the_centroid_of_the_used_points(fitted: Fitted) -> None:
    """By the normal matrix written out, with weights that draw the pivot of the fit metres away from the centroid."""
    p, w = seen(), np.where(J[:, 0] > 0.0, 400.0, 1.0)
    weights = ",".join(f"{n}={v}" for n, v in zip(NAMES, w, strict=True))
    told = fitted(p, "--noise", "iso:0.05", "--weights", weights)[1]
    assert told["used"] == NAMES
    normal, turned = np.zeros((6, 6)), p - p.mean(axis=0)
    for (x, y, z), weight in zip(turned, w, strict=True):
        a = np.array([[0.0, z, -y, 1.0, 0.0, 0.0], [-z, 0.0, x, 0.0, 1.0, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]])
        normal += weight / 0.05**2 * a.T @ a
    expected = np.linalg.inv(normal)
    size = np.sqrt(np.diag(expected))
    assert np.max(np.abs(expected[:3, 3:] / np.outer(size[:3], size[3:]))) > 0.5
    assert np.allclose(np.array(told["covariance"]) / np.outer(size, size), expected / np.outer(size, size), atol=1e-3)


def test_sigma_columns_win_over_the_noise(fitted: Fitted) -> None:
    plain, stated = (fitted(seen(), "--noise", "iso:0.04", sigma=s)[1] for s in ("", ",0.08,0.08,0.08"))
    assert plain["used"] == stated["used"] == NAMES
    assert stated["chi2"] == pytest.approx(plain["chi2"] / 4.0, rel=1e-6)
    assert stated["sigma"]["x_mm"] == pytest.approx(2.0 * plain["sigma"]["x_mm"], rel=1e-6)


def test_sigma_columns_alone_state_the_noise(fitted: Fitted) -> None:
    """Nominal points without sigma are exact then, as they are beside --noise."""
    column, option = fitted(seen(), sigma=",0.04,0.04,0.04")[1], fitted(seen(), "--noise", "iso:0.04")[1]
    assert column == option
    assert column["chi2_p"] is not None


def test_exact_points_are_all_kept(fitted: Fitted) -> None:
    """What is left is rounding, in which no point stands out."""
    for grid in (J, np.round(J), J + 1e6):
        told = fitted(grid, nominal=grid)[1]
        assert (told["used"], told["rejected"]) == (NAMES, [])


def test_without_sigmas_chi_square_proves_nothing(fitted: Fitted) -> None:
    told = fitted(seen())[1]
    assert told["chi2_p"] is None
    assert told["sigma"]["x_mm"] > 0.0


def test_a_lost_beam_takes_nothing_from_the_judgement(fitted: Fitted) -> None:
    p = seen()
    p[6] = 0.0
    told = fitted(p, *TRACKER)[1]
    assert {r["name"]: r["reason"] for r in told["rejected"]} == {"T7": "lost-beam"}
    assert 0.001 < told["chi2_p"] < 0.999


@pytest.mark.parametrize("method", ["svd", "least-squares", "three-point"])
def test_the_other_methods_carry_a_covariance_too(fitted: Fitted, method: str) -> None:
    told = fitted(seen(), *TRACKER, "--method", method)[1]
    best = fitted(seen(), *TRACKER)[1]
    assert told["method"] == method
    assert told["chi2_p"] is None
    assert np.trace(np.array(told["covariance"])[3:, 3:]) >= np.trace(np.array(best["covariance"])[3:, 3:])


def test_swapped_points_are_named(fitted: Fitted) -> None:
    p = seen()
    p[[2, 5]] = p[[5, 2]]
    told = fitted(p, *TRACKER)[1]
    assert told["swapped"] == {"T3": "T6", "T6": "T3"}
    assert {r["name"]: r["reason"] for r in told["rejected"]} == {"T3": "swapped", "T6": "swapped"}


def test_locks_hold(fitted: Fitted) -> None:
    told = fitted(seen(), *TRACKER, "--lock", "z=300,alpha=1,gamma=30")[1]
    assert told["pose"]["z_mm"] == pytest.approx(300.0, abs=1e-9)
    assert told["pose"]["alpha_deg"] == pytest.approx(1.0, abs=1e-9)
    assert told["dof"] == 27
    assert told["sigma"]["z_mm"] < 1e-6 < told["sigma"]["x_mm"]
    at_zero = fitted(pose_from_vector([5.0, 0.0, 0.0, 0.0, 0.0, 3.0]).apply(J), "--lock", "y,z,alpha,beta")[1]
    assert [at_zero["pose"][k] for k in SIX] == pytest.approx([5.0, 0.0, 0.0, 0.0, 0.0, 3.0], abs=1e-6)


@pytest.mark.parametrize("noise", [("--noise", "iso:0.05"), ()])
def test_held_values_are_judged(fitted: Fitted, noise: tuple[str, ...]) -> None:
    """True values are called doubtful as often as the level says; values half a millimetre off always."""
    X, levels = pose_from_vector(VECTOR), []
    for seed in range(80):
        p = X.apply(J) + np.random.default_rng(seed).normal(0.0, 0.05, J.shape)
        told = fitted(p, *noise, "--lock", "x=100,z=300,gamma=30")[1]
        if len(told["used"]) == len(NAMES):
            levels.append(told["locks_p"])
    assert len(levels) > 70
    assert np.mean(levels) == pytest.approx(0.5, abs=4.0 * np.sqrt(1.0 / 12.0 / len(levels)))
    assert np.mean(np.array(levels) < 0.2) == pytest.approx(0.2, abs=4.0 * np.sqrt(0.16 / len(levels)))
    assert fitted(p, *noise, "--lock", "z=300.5")[1]["locks_p"] < 1e-6
    for weights in ((), ("--weights", "T1=400,T2=3")):
        exact = fitted(X.apply(J), *noise, *weights, "--lock", "z=300,beta=-2")[1]
        assert exact["locks_p"] > 0.99
        assert 1e-6 < exact["sigma"]["x_mm"] < 0.05
    assert fitted(p, *noise)[1]["locks_p"] is None


def test_weights_are_ratios_where_the_residuals_tell_the_scale(fitted: Fitted) -> None:
    """Whoever gives 1 / sigma^2 as weights gets the same sigmas as whoever gives 1 and 4, and true ones."""
    X, sigma, squares = pose_from_vector(VECTOR), np.where(np.arange(10) < 5, 0.04, 0.08), []
    small, large = (",".join(f"{n}={w / s**2:.12g}" for n, s in zip(NAMES, sigma, strict=True)) for w in (1.0, 0.04**2))
    for seed in range(100):
        p = X.apply(J) + sigma[:, None] * np.random.default_rng(seed).normal(size=J.shape)
        told = fitted(p, "--weights", small)[1]
        if len(told["used"]) == 10:
            squares.append([((told["pose"][k] - t) / told["sigma"][k]) ** 2 for k, t in zip(SIX, VECTOR, strict=True)])
    other = fitted(p, "--weights", large)[1]
    assert other["sigma"] == pytest.approx(told["sigma"], rel=1e-6)
    assert other["chi2"] == pytest.approx(told["chi2"], rel=1e-6)
    # A square over a variance from 24 degrees of freedom has the mean 24 / 22.
    assert np.mean(squares) == pytest.approx(24.0 / 22.0, abs=4.0 * np.sqrt(2.0 / len(squares) / 3.0))


def test_excluded_points_and_a_chosen_triangle(fitted: Fitted) -> None:
    told = fitted(seen(), *TRACKER, "--exclude", "T3,T7", "--exclude", "T1")[1]
    assert told["used"] == ["T2", "T4", "T5", "T6", "T8", "T9", "T10"]
    assert {r["reason"] for r in told["rejected"]} == {"excluded"}
    told = fitted(seen(), *TRACKER, "--method", "three-point", "--triangle", "T1,T2,T4")[1]
    assert np.linalg.norm(told["residuals_mm"]["T4"]) < 1e-6


def test_a_stated_temperature_grows_the_nominal(fitted: Fitted) -> None:
    grown = 1.0 + 20.0 * 23.1e-6
    p = pose_from_vector(VECTOR).apply(J * grown)
    cold = fitted(p, "--noise", "iso:0.02")
    code, told = fitted(p, "--noise", "iso:0.02", "--temperature", "20@23.1e-6")
    assert (code, told["scale"]) == (0, pytest.approx(grown, rel=1e-12))
    assert told["max_mm"] < 1e-4
    assert cold[0] == 1
    assert "deformed: growth" in cold[1]["refused"] or "nominal shape" in cold[1]["refused"]


def off_mm(told: dict[str, Any], name: str) -> float:
    return float(np.linalg.norm(told["residuals_mm"][name]))


@pytest.mark.parametrize("method", ["ml", "svd", "least-squares"])
def test_a_heavy_point_pulls_and_a_light_one_gives_way(fitted: Fitted, method: str) -> None:
    noise = ("--noise", "iso:0.05", "--method", method)
    plain, heavy, light = (
        fitted(seen(), *noise, *extra)[1] for extra in ((), ("--weights", "T4=1e6"), ("--weights", "T4=1e-6"))
    )
    assert off_mm(heavy, "T4") < 1e-3 * off_mm(plain, "T4")
    assert off_mm(light, "T4") > 1.05 * off_mm(plain, "T4")
    without = fitted(seen(), *noise, "--exclude", "T4")[1]
    assert [light["pose"][k] for k in SIX] == pytest.approx([without["pose"][k] for k in SIX], abs=1e-4)


def test_a_column_of_weights_is_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A weight of 4 is half the sigma; the option goes before the column; passes of a point have one weight."""
    n, m = points(tmp_path / "n.csv", J), points(tmp_path / "m.csv", seen())
    head, *rows = m.read_text().splitlines()
    column = tmp_path / "w.csv"

    def run(file: Path, *options: str) -> dict[str, Any]:
        call(["fit", str(n), str(file), "--noise", "iso:0.05", *options, "--json"])
        told: dict[str, Any] = json.loads(capsys.readouterr().out)
        return told

    column.write_text("\n".join([head + ",weight", *(row + (",4" if k < 3 else ",1") for k, row in enumerate(rows))]))
    by_option = run(m, "--weights", "T1=4,T2=4,T3=4")
    assert run(column)["pose"] == by_option["pose"] != run(m)["pose"]
    assert run(column, "--weights", "T1=1,T2=1,T3=1")["pose"] == run(m)["pose"]
    stated = tmp_path / "s.csv"
    cells = (row + (",0.025" * 3 if k < 3 else ",0.05" * 3) for k, row in enumerate(rows))
    stated.write_text("\n".join([head + ",sx_mm,sy_mm,sz_mm", *cells]))
    assert run(stated)["chi2"] == pytest.approx(by_option["chi2"], rel=1e-6)
    column.write_text("\n".join([head + ",weight", *(row + ",2" for row in rows), rows[0] + ",3"]))
    error = run(column)["error"]
    assert (error["code"], error["where"]) == (4003, str(column))


def test_three_points_have_no_redundancy(fitted: Fitted) -> None:
    told = fitted(seen(), *TRACKER, "--exclude", ",".join(NAMES[3:]))[1]
    assert (told["redundancy"], told["used"]) == (0, ["T1", "T2", "T3"])


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--noise", "iso"), "--noise"),
        (("--noise", "iso:-1"), "--noise"),
        (("--noise", "tracker:1,2"), "--noise"),
        (("--lock", "w"), "--lock"),
        (("--lock", "x,x"), "--lock"),
        (("--lock", "x=nan"), "--lock"),
        (("--lock", "x", "--method", "svd"), "--lock"),
        (("--exclude", "T99"), "--exclude"),
        (("--temperature", "5"), "--temperature"),
        (("--temperature", "5@0"), "--temperature"),
        (("--temperature", "nan@1e-5"), "--temperature"),
        (("--weights", "T1"), "--weights"),
        (("--weights", "T1=0"), "--weights"),
        (("--weights", "T1=nan"), "--weights"),
        (("--weights", "T1=2,T1=3"), "--weights"),
        (("--weights", "T99=2"), "--weights"),
        (("--weights", "T1=2", "--method", "three-point"), "--weights"),
        (("--triangle", "T1,T2,T3"), "--triangle"),
        (("--method", "three-point", "--triangle", "T1,T2"), "--triangle"),
        (("--method", "three-point", "--triangle", "T1,T2,X"), "--triangle"),
    ],
    ids=str,
)
def test_a_wrong_option_is_named(fitted: Fitted, options: tuple[str, ...], named: str) -> None:
    code, told = fitted(seen(), *options)
    assert (code, told["error"]["code"], told["error"]["where"]) == (2, 4004, named)


def test_a_page_of_its_own(fitted: Fitted, tmp_path: Path) -> None:
    p = seen()
    p[4] += [3.0, 1.0, 0.0]
    page = tmp_path / "fit.html"
    code, _ = fitted(p, *TRACKER, "--report", page)
    text = page.read_text("utf-8")
    assert code == 0
    assert text.count("<svg") == 2
    assert "prefers-color-scheme:dark" in text
    assert not re.search(r"(?:src|href)\s*=\s*[\"'](?!#)", text)
    for word in ("mis-aimed", "T5", "chi2", "alpha_deg", "residual / mm"):
        assert word in text
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))


def test_a_refused_fit_has_a_page_too(fitted: Fitted, tmp_path: Path) -> None:
    page = tmp_path / "fit.html"
    code, told = fitted(1000.0 * seen(), *TRACKER, "--report", page)
    assert code == 1
    assert told["sigma"] is None
    assert (told["refused_code"], "Correct the unit" in told["remedy"]) == (3011, True)
    assert "No pose: 3011" in page.read_text("utf-8")
    assert told["remedy"] in page.read_text("utf-8")
    code, told = fitted(seen(), "--report", tmp_path / "no" / "where.html")
    assert (code, told["error"]["code"]) == (2, 4005)


@pytest.mark.parametrize(("noise", "said"), [("iso:0.03", "as the sigmas let"), ("iso:5", "too large")])
def test_chi_square_is_put_into_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], noise: str, said: str
) -> None:
    p = pose_from_vector(VECTOR).apply(J) + 0.03 * np.random.default_rng(2).normal(size=J.shape)
    files = points(tmp_path / "n.csv", J), points(tmp_path / "m.csv", p)
    call(["fit", *map(str, files), "--noise", noise])
    out = capsys.readouterr().out
    assert said in out


def test_a_refusal_has_its_code_and_its_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = points(tmp_path / "n.csv", J), points(tmp_path / "m.csv", seen() * [1.0, -1.0, 1.0])
    assert call(["fit", *map(str, files)]) == 1
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("no pose: 3003: fit: ")
    assert "mirror image" in first
    assert second.startswith("    -> ")


def test_a_person_is_told_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = points(tmp_path / "n.csv", J), points(tmp_path / "m.csv", seen())
    assert call(["fit", *map(str, files), "--exclude", ",".join(NAMES[3:])]) == 0
    out = capsys.readouterr().out
    assert "NO REDUNDANCY" in out
    assert "one sigma" in out
