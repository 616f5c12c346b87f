"""The sky in the thermal band: its laws beside tables and one another, and clouds."""

import pytest
import torch

from heatsplat.physics.sky import LAWS, dew_point_c, law_for, sky_temperature_k, vapour_pressure_hpa
from heatsplat.physics.units import KELVIN_AT_0_C

AIR_K = torch.linspace(265.0, 310.0, 10, dtype=torch.float64)
HALF = torch.full_like(AIR_K, 50.0)


def test_vapour_and_dew_point_are_those_of_the_tables():
    """Saturation over water at 20 °C is 23.4 hPa; air of 20 °C at 50 % has its dew point at 9.3 °C."""
    at_20 = torch.tensor(20.0 + KELVIN_AT_0_C, dtype=torch.float64)
    assert float(vapour_pressure_hpa(at_20, torch.tensor(100.0))) == pytest.approx(23.4, abs=0.1)
    assert float(dew_point_c(vapour_pressure_hpa(at_20, torch.tensor(50.0)))) == pytest.approx(9.3, abs=0.1)


@pytest.mark.parametrize("law", LAWS)
def test_a_clear_sky_is_colder_than_the_air_and_clouds_warm_it_up_to_that(law):
    clear, half, closed = (sky_temperature_k(AIR_K, HALF, law, clouds) for clouds in (0.0, 0.5, 1.0))
    assert (clear < AIR_K - 5.0).all() and (clear > AIR_K - 45.0).all()
    torch.testing.assert_close(half**4, 0.5 * (clear**4 + AIR_K**4))
    torch.testing.assert_close(closed, AIR_K)
    torch.testing.assert_close(sky_temperature_k(AIR_K, HALF, law, torch.zeros_like(AIR_K)), clear, rtol=0, atol=0)


def test_the_laws_of_moist_skies_agree_within_what_they_were_fitted_to():
    moist = torch.stack([sky_temperature_k(AIR_K, HALF, law) for law in LAWS if law != "swinbank"])
    assert (moist.amax(0) - moist.amin(0)).max() < 10.0
    swinbank = sky_temperature_k(AIR_K, None, "swinbank")
    torch.testing.assert_close(swinbank, 0.0552 * AIR_K**1.5)


@pytest.mark.parametrize("law", [law for law in LAWS if law != "swinbank"])
@pytest.mark.parametrize("air_c", [-40.0, 0.0, 40.0])
def test_the_drier_the_air_the_colder_the_sky_down_to_none_that_a_station_tells(law, air_c):
    """Stations round to whole per cent, so that dry air has a humidity of 0."""
    humidity = torch.linspace(0.0, 100.0, 201, dtype=torch.float64)
    air_k = torch.full_like(humidity, air_c + KELVIN_AT_0_C)
    sky_k = sky_temperature_k(air_k, humidity, law)
    assert (sky_k.diff() >= 0).all()
    assert 0.65 < sky_k[0] / air_k[0] < 0.9
    assert sky_k[0] == sky_temperature_k(air_k[0], torch.tensor(1.0, dtype=torch.float64), law)


def test_what_is_missing_or_unknown_is_named():
    with pytest.raises(ValueError, match="needs the humidity; without it there is swinbank"):
        sky_temperature_k(AIR_K, None, "brunt")
    with pytest.raises(ValueError, match="law of the sky must be one of"):
        sky_temperature_k(AIR_K, HALF, "blue")


def test_a_law_that_is_not_named_follows_from_what_the_station_tells():
    assert (law_for("auto", humid=True), law_for("auto", humid=False)) == ("brutsaert", "swinbank")
    assert all(law_for(law, humid) == law for law in LAWS for humid in (True, False))
