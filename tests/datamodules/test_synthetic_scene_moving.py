"""The simulated detector that lags and is read row by row, against a solver of its differential equation."""

import pytest
from scipy.integrate import solve_ivp
from swinging import HEIGHT, TIMES, recorded, wall


def test_the_simulated_camera_solves_the_heat_balance_of_its_pixels():
    tau, readout, (row, column) = 0.012, 0.02, (2, 6)
    read = recorded(tau, readout)[3, row, column].item()
    due = TIMES[3].item() + ((row + 0.5) / HEIGHT - 0.5) * readout
    seen = lambda t: wall(t)[0][row, column].item()  # noqa: E731
    start = due - 20 * tau
    solved = solve_ivp(lambda t, y: (seen(t) - y) / tau, (start, due), [seen(start)], rtol=1e-9, atol=1e-12)
    assert read == pytest.approx(solved.y[0, -1], abs=1e-4)
    assert abs(read - seen(TIMES[3].item())) > 0.02
