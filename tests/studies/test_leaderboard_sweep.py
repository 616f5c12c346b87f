"""A sweep that fills the leaderboard."""

from boards import board, protocol_folder

from heatsplat.studies.leaderboard.sweep import Leaderboard


def test_one_job_of_each_method_and_track_shows_whether_all_compose(tmp_path):
    asked = board(protocol_folder(tmp_path, "heath", "coarse_camera", "cooling"))
    plan = Leaderboard(asked)
    jobs, first = plan.jobs([["threads=1"]], None)
    assert (jobs, first) == (asked.jobs(["threads=1"]), 0) and not plan.idle
    methods = sorted(text for job in plan.to_compose(jobs) for text in job if text.startswith("method="))
    assert set(methods) == {"method=3dgs", "method=etgs", "method=supirgs"} and len(methods) < len(jobs)
    assert Leaderboard(board(tmp_path, train=False)).idle
