"""What was run, as metrics.json and TensorBoard have it."""

from heatsplat.callbacks.describe import hyperparameters


def test_hyperparameters_are_flat_and_say_what_was_learned():
    config = {
        "name": "etgs",
        "seed": 3,
        "thermal": {"_target_": "heatsplat.thermal.newton_harmonic.NewtonHarmonic", "frequencies": 24, "grid": [1, 2]},
        "trainer": {"accelerator": "cpu"},
    }
    flat = hyperparameters(config)
    assert flat == {
        "name": "etgs",
        "seed": 3,
        "thermal": "NewtonHarmonic",
        "thermal.frequencies": 24,
        "thermal.grid": "[1, 2]",
    }
