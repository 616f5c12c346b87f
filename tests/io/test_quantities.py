"""Names of quantities as people read them."""

from heatsplat.io.quantities import moment, words_and_unit


def test_the_longest_suffix_is_the_unit():
    assert words_and_unit("time_constant_s") == ("time constant", "s")
    assert words_and_unit("source_c_per_h") == ("source", "°C/h")
    assert words_and_unit("heat_loss_w_m2_k") == ("heat loss", "W/(m² K)")
    assert words_and_unit("emissivity") == ("emissivity", "")


def test_long_records_are_told_in_hours():
    assert (moment(90.04), moment(-5.0), moment(86902.0)) == ("90.0 s", "-5.0 s", "24.14 h")
    assert words_and_unit("effusivity_j_m2_k_s05") == ("effusivity", "J/(m² K √s)")
