"""The work-precision study: errors and orders are right, what is given up is said, pages and pictures are complete."""

import csv
import sys

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from running import compose_run

from benchmarks.work_precision import problems, report, solvers
from benchmarks.work_precision import study as work_precision
from heatsplat import cli
from heatsplat.composition import compose
from heatsplat.contracts import SceneError

TINY = {
    "gaussians": 48, "frames": 4, "frequencies": 24, "sample": 4, "types": ["float32", "float64"], "steps": {},
    "tolerances": [], "rates": [129], "rounds": 1, "once_above_s": 0.0, "limit_s": 10.0, "adaptive_limit_s": 10.0,
}  # fmt: skip


def measured(**settings):
    return work_precision.measurements(**TINY | settings)[0]


def worst(rows, problem, solver, kind="float64"):
    return [r.worst_k for r in rows if (r.problem, r.solver, r.type) == (problem, solver, kind) and not r.given_up]


def test_ours_is_exact_and_the_printed_formula_loses_its_phases():
    rows = measured(only=["cooling", "driven", "stiff"], solvers=[])
    for problem in ("cooling", "driven", "stiff"):
        assert worst(rows, problem, "closed form, fused kernel", "float32")[0] < 1e-4
        assert worst(rows, problem, "closed form, torch", "float32")[0] < 1e-4
        assert worst(rows, problem, "closed form, torch")[0] < 1e-12
    assert worst(rows, "driven", "printed formula", "float32")[0] > 3e-4
    assert all(r.us > 0 and r.us == r.us_alone for r in rows)


def test_ours_follows_the_weather_with_and_without_fourth_powers():
    few = {"types": ["float32"], "gaussians": 16, "sample": 2, "frames": 2}  # the fastest and the slowest of all
    rows = measured(only=["thin", "weather_linear"], solvers=[], **few)
    steps = {"weather_full": [400.0, 200.0]}
    rows += measured(only=list(steps), solvers=["ETD2"], steps=steps, **few)
    bounds = {"thin": 1e-3, "weather_linear": 1e-4, "weather_full": 2e-2}
    for problem, bound in bounds.items():
        assert worst(rows, problem, "balance, time-stepped kernel", "float32")[0] < bound
    assert worst(rows, "weather_linear", "rate table", "float32")[0] < 1e-3
    assert worst(rows, "weather_full", "rate table", "float32")[0] > 1e-2  # it is linear, the problem is not
    coarse, fine = worst(rows, "weather_full", "ETD2", "float32")
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize(
    ("problem", "solver", "steps", "order"),
    [
        ("cooling", "explicit Euler", (2.0, 1.0), 1),
        ("cooling", "RK4", (4.0, 2.0), 4),
        ("stiff", "exponential Euler", (8.0, 4.0), 1),
        ("stiff", "ETD2", (8.0, 4.0), 2),
    ],
)
def test_solvers_have_their_order(problem, solver, steps, order):
    rows = measured(only=[problem], solvers=[solver], steps={problem: steps}, types=["float64"], gaussians=16)
    coarse, fine = worst(rows, problem, solver)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.5)
    if problem == "cooling":  # to frames at 1/4, 2/4, 3/4 and 4/4 of the record, each from the start
        assert all(r.us_alone == pytest.approx(2.5 * r.us) for r in rows if r.solver == solver)


def test_exponential_steps_are_exact_where_they_should_be(monkeypatch):
    monkeypatch.setattr(work_precision, "_forms", lambda *_: [])  # ours has a kernel for each type and balance
    rows = measured(only=["cooling"], solvers=["exponential Euler"], steps={"cooling": [600.0]})
    rows += measured(only=["weather_linear"], solvers=["ETD2"], types=["float64"], steps={"weather_linear": [600.0]})
    assert worst(rows, "cooling", "exponential Euler")[0] < 1e-11
    assert worst(rows, "weather_linear", "ETD2")[0] < 1e-11


def test_adaptive_solvers_come_closer_with_their_tolerance():
    pytest.importorskip("torchdiffeq", reason="torchdiffeq is not installed")
    rows = measured(only=["cooling"], solvers=list(solvers.ADAPTIVE), tolerances=[1e-2, 1e-5], types=["float64"])
    for solver in solvers.ADAPTIVE:
        coarse, fine = worst(rows, "cooling", solver)
        assert fine < coarse / 30 and fine < 1e-2


def test_both_truths_agree_where_both_hold():
    problem = problems.problems(4, 3, 1)["weather_linear"]()
    surface, climate = problem.equation.args
    moments = (100.0, 4321.0, 9000.0)
    exact = problems.linear_truth(surface, climate, moments, 3)
    stiff = problems.stiff_truth(surface, climate, moments, 3)
    assert np.abs(exact - stiff).max() < 1e-9


def test_what_is_given_up_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchdiffeq", None)
    rows = measured(
        only=["cooling"],
        solvers=["dopri5 (torchdiffeq)", "RK4"],
        steps={"cooling": [50.0, 1e-4]},
        tolerances=[1.0],
        limit_s=0.5,
    )
    given_up = {(r.solver, r.type): r.given_up for r in rows if r.given_up}
    missing = "dopri5 (torchdiffeq) is left out: pip install torchdiffeq"
    assert given_up == {
        ("dopri5 (torchdiffeq)", "float32"): missing,
        ("dopri5 (torchdiffeq)", "float64"): missing,
        ("RK4", "float32"): "over 0.5 s",
        ("RK4", "float64"): "over 0.5 s",
    }
    text = "\n".join(report.markdown(rows, {"cooling": "Cooling"}))
    assert f"| – | tolerance 1 K: {missing} |" in text  # no smallest error
    assert "0.0001 s: over 0.5 s" in text
    equation = solvers._Clocked(problems.problems(4, 3, 0)["cooling"]().equation(torch.float64), limit_s=-1.0)
    with pytest.raises(solvers.OverLimit):
        equation.slope(0.0, torch.zeros(4).double())


def test_the_front_holds_what_nothing_beats():
    def row(us, error, given_up=""):
        return work_precision.Row("p", "RK4", "", "float32", False, us, us, error, error, given_up=given_up)

    quick, exact, beaten, blown = row(1, 0.1), row(3, 1e-3), row(2, 0.2), row(0.1, np.inf)
    assert report.front([beaten, exact, blown, quick, row(0.0, 0.0, "over")], "us") == [quick, exact]
    rounding = [row(1.0, 1e-13), row(4.0, 6e-14)]  # both at the lower edge of the picture
    assert report.front(rounding, "us") == rounding[:1]


def test_the_study_runs_from_its_configuration(tmp_path):
    small = ["gaussians=16", "frames=2", "sample=2", "frequencies=2", "rounds=1", "only=[cooling]", "solvers=[RK4]"]
    document = tmp_path / "page.md"
    overrides = [f"study.{x}" for x in (*small, f"document={document}", f"pictures={tmp_path}")]
    config = compose_run("study=work_precision", *overrides, config_name="study")
    rows = cli.build(OmegaConf.to_container(config.study, resolve=True), output_dir=tmp_path)
    with open(tmp_path / "work_precision.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    for name in ("work_precision", "work_precision_alone"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert "RK4" in (tmp_path / f"{name}.svg").read_text()
    text = (tmp_path / "table.md").read_text()
    assert "## Rules" in text and "the front consists of" in text and "nan" not in text
    assert not document.exists()  # half a table does not replace a whole one
    with pytest.raises(SceneError, match="each of study.solvers must be one of explicit Euler.*got 'RK5'"):
        measured(solvers=["RK5"])
    assert {row.problem for row in measured(only="cooling", solvers=[])} == {"cooling"}


def test_the_page_is_written_only_with_the_settings_that_it_states(tmp_path, monkeypatch):
    rows = measured(only=["cooling"], solvers=[], types=["float32"])
    monkeypatch.setattr(work_precision, "measurements", lambda **_: (rows, {"cooling": "Cooling"}))
    monkeypatch.setattr(report, "picture", lambda *_: Figure(figsize=(1, 1)))  # they are looked at above
    usual = compose(["study=work_precision"], "study")["study"]
    usual = {key: value for key, value in usual.items() if key not in ("_target_", "document", "pictures")}
    page = tmp_path / "page.md"
    for changed in ({"gaussians": 16}, {"types": ["float32"]}, {"solvers": ["RK4"]}):
        work_precision.run(tmp_path, str(page), str(tmp_path), **usual | changed)
        assert not page.exists()
    work_precision.run(tmp_path, str(page), str(tmp_path), **usual)
    assert page.exists()
