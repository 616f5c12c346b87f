"""What a plan does that says nothing else."""

from heatsplat.studies.sweep_plan import SweepPlan


class Nothing(SweepPlan):
    def jobs(self, grid, folder_of):
        return [], 0

    def write(self, folder):
        return []


def test_a_plan_runs_and_tells_nothing_and_composes_all_jobs_that_differ_in_more_than_the_seed():
    plan, steps = Nothing(), ("max_steps=1", "max_steps=2")
    jobs = [[f"seed={seed}", text, "data.seed=3"] for seed in (0, 1) for text in steps]
    assert not plan.idle and plan.summary() == "" and plan.to_compose(jobs) == jobs[:2]
    assert plan.to_compose([["data.seed=0"], ["data.seed=1"]]) == [["data.seed=0"], ["data.seed=1"]]
