"""Networks: trained with torch where it is installed, run without it; what a user relies on of ensembles."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

from harness.conformance import check_identifier
from harness.errors import InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import equation_error, simulation_error
from harness.scoring.predictive import probability_score
from identifiers.learned.neural import EnsembleModel, NeuralNetwork
from identifiers.learned.neural_state import NeuralStateModel, NeuralStateSpace
from identifiers.learned.training import need_torch
from identifiers.linear.least_squares import Arx

torch_needed = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install 'sysid-harness[learned]'"
)


def pendulum(samples: int, noise: float, amplitude: float = 1.0):
    plant = create("plants", "pendulum-ode", sample_time=0.05, outputs=[["theta", 0], ["theta", 1]])
    scenario = create("scenarios", "multisine", samples=samples, amplitude=amplitude, band=[0.05, 3.0], noise=noise)
    streams = Streams("pendulum-ode", "multisine", 0)
    first, second = (run(plant, scenario, streams=streams, role=f"{role}/0") for role in ("estimation", "validation"))
    return first.measured(), second.measured()


def test_a_missing_torch_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r"sysid-harness\[learned\]"):
        need_torch("neural-network")


def test_the_identifier_is_listed_without_importing_torch():
    code = "import sys; from harness.registry import create; create('identifiers', 'neural-network'); "
    code += "print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@torch_needed
def test_an_ensemble_beats_the_affine_model_and_its_bands_hold():
    learn, held = pendulum(1500, 0.01)
    model = NeuralNetwork(steps=600, members=4, hidden=(24,)).fit([learn], rng=np.random.default_rng(0))
    affine = Arx(order=1).fit([learn], rng=np.random.default_rng(0))
    ours, theirs = equation_error(model, held).nrmse, equation_error(affine, held).nrmse
    assert ours[0] < 1.01 * theirs[0], "the angle's error is noise"
    assert ours[1] < 0.97 * theirs[1]
    assert (simulation_error(model, held).nrmse < simulation_error(affine, held).nrmse).all()
    coverage = probability_score(model, held).coverage[2]
    assert (coverage > 0.85).all()
    assert (coverage < 0.95).all()


@torch_needed
def test_the_same_seed_gives_the_same_model_and_a_stopped_fit_goes_on(tmp_path):
    learn, _ = pendulum(300, 0.01)
    options = dict(members=2, hidden=(8,))
    whole = NeuralNetwork(steps=100, **options).fit([learn], rng=np.random.default_rng(1))
    again = NeuralNetwork(steps=100, **options).fit([learn], rng=np.random.default_rng(1))
    assert json.dumps(whole.to_dict()) == json.dumps(again.to_dict())
    file = tmp_path / "fit.pt"
    kept = NeuralNetwork(steps=100, checkpoint=str(file), **options)
    assert json.dumps(kept.fit([learn], rng=np.random.default_rng(1)).to_dict()) == json.dumps(whole.to_dict())
    assert file.is_file()
    continued = kept.fit([learn], rng=np.random.default_rng(1))  # from the last step: nothing is left to do
    assert json.dumps(continued.to_dict()) == json.dumps(whole.to_dict())
    other = NeuralNetwork(steps=100, checkpoint=str(file), **options).fit([learn], rng=np.random.default_rng(2))
    assert json.dumps(other.to_dict()) != json.dumps(whole.to_dict()), "another training is not continued"


@torch_needed
def test_a_fit_that_was_interrupted_ends_where_a_whole_one_does(tmp_path, monkeypatch):
    import torch

    learn, _ = pendulum(300, 0.01)
    identifier = NeuralNetwork(steps=150, members=2, hidden=(8,), checkpoint=str(tmp_path / "fit.pt"))
    saves = []
    save = torch.save

    def stop(*args, **kwargs) -> None:
        save(*args, **kwargs)
        saves.append(1)
        if len(saves) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        identifier.fit([learn], rng=np.random.default_rng(1))
    monkeypatch.setattr(torch, "save", save)
    resumed = identifier.fit([learn], rng=np.random.default_rng(1))
    whole = NeuralNetwork(steps=150, members=2, hidden=(8,)).fit([learn], rng=np.random.default_rng(1))
    assert json.dumps(resumed.to_dict()) == json.dumps(whole.to_dict())


@torch_needed
def test_the_model_runs_without_torch():
    learn, held = pendulum(300, 0.01)
    model = NeuralNetwork(steps=60, members=2, hidden=(8,)).fit([learn], rng=np.random.default_rng(1))
    read = EnsembleModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(equation_error(read, held).rms, equation_error(model, held).rms)


@torch_needed
@pytest.mark.parametrize(("order", "kind"), [(1, "pendulum, rate measured"), (2, "pendulum")])
def test_the_contract(order, kind):
    options = dict(order=order, members=2, steps=40, hidden=(6,))
    results = check_identifier(lambda: create("identifiers", "neural-network", **options), kinds=(kind,), examples=1)
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []


@torch_needed
def test_a_state_space_network_learns_what_an_arx_model_cannot():
    plant = create("plants", "pendulum-ode", sample_time=0.05)
    scenario = create("scenarios", "multisine", samples=1200, amplitude=2.0, band=[0.05, 3.0], noise=0.005)
    streams = Streams("pendulum-ode", "multisine", 0)
    learn, held = (run(plant, scenario, streams=streams, role=f"{role}/0").measured() for role in ("e", "v"))
    options = dict(order=2, hidden=12, window=25, batch=64)
    model = NeuralStateSpace(steps=400, **options).fit([learn], rng=np.random.default_rng(0))
    arx = Arx(order=2).fit([learn], rng=np.random.default_rng(0))
    assert simulation_error(model, held).nrmse[0] < 0.5 * simulation_error(arx, held).nrmse[0]
    read = NeuralStateModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(simulation_error(read, held).rms, simulation_error(model, held).rms)


@torch_needed
def test_the_state_space_network_keeps_the_contract():
    options = dict(order=2, hidden=4, window=15, steps=20)
    results = check_identifier(
        lambda: create("identifiers", "neural-state-space", **options), kinds=("linear",), examples=1
    )
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []
