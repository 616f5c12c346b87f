"""What was run, as metrics.json and TensorBoard have it."""

from types import SimpleNamespace

from heatsplat.callbacks.describe import describe_effects, hyperparameters


def test_hyperparameters_are_flat_and_say_what_was_learned():
    config = {
        "name": "etgs",
        "seed": 3,
        "thermal": {"_target_": "heatsplat.thermal.newton_harmonic.NewtonHarmonic", "frequencies": 24, "grid": [1, 2]},
        "trainer": {"accelerator": "cpu"},
        "data": {"scene": "M\udcfcller"},  # a byte that is no UTF-8, which TensorBoard refuses
    }
    flat = hyperparameters(config)
    assert flat == {
        "name": "etgs",
        "seed": 3,
        "data.scene": r"M\udcfcller",
        "thermal": "NewtonHarmonic",
        "thermal.frequencies": 24,
        "thermal.grid": "[1, 2]",
    }


def test_what_is_simulated_of_an_effect_that_is_off_is_told():
    verdict = dict.fromkeys(("told", "statistic", "threshold", "gain_db", "reason"))
    module = SimpleNamespace(
        config={"verdicts": {name: verdict | {"on": name == "solar"} for name in ("solar", "convection", "tone")}},
        thermal=SimpleNamespace(effects=lambda: {"solar": {"sky": "isotropic"}, "convection": {"rain": "3.1 h wet"}}),
        sensor=SimpleNamespace(effects=dict),
    )
    told = describe_effects(module)
    assert told["solar"]["settings"] == {"sky": "isotropic"} and told["tone"] == verdict | {
        "on": False,
        "parameters": 0,
        "ms_per_step": 0.0,
    }
    assert not told["convection"]["on"] and told["convection"]["settings"] == {"rain": "3.1 h wet"}
