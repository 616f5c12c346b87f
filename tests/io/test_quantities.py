"""Names of quantities as people read them."""

from heatsplat.io.quantities import words_and_unit


def test_the_longest_suffix_is_the_unit():
    assert words_and_unit("time_constant_s") == ("time constant", "s")
    assert words_and_unit("source_c_per_h") == ("source", "°C/h")
    assert words_and_unit("heat_loss_w_m2_k") == ("heat loss", "W/(m² K)")
    assert words_and_unit("emissivity") == ("emissivity", "")
