from benchmarks.palettes import ENCODINGS, costs, recorded


def test_costs_rise_with_compression():
    found = [*costs(recorded("tiny", 2), ["iron"])]
    assert len(found) == len(ENCODINGS) and {cost.palette for cost in found} == {"iron"}
    assert found[0].encoding == "PNG" and found[-1].encoding == "JPEG 75, 4:2:0"
    assert found[0].median < 0.15 and found[0].most < 0.25 and found[0].left_out == 0.0
    assert found[0].median < found[-1].median < 3.0 and found[-1].most < 10.0
    assert all(cost.ms > 0 for cost in found)
