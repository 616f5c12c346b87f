"""What a plan does that says nothing else."""

from heatsplat.studies.sweep_plan import SweepPlan


class Nothing(SweepPlan):
    def jobs(self, grid, folder_of):
        return [], 0

    def write(self, folder):
        return []


def test_a_plan_runs_and_composes_all_jobs_and_tells_nothing():
    plan, jobs = Nothing(), [["seed=0"], ["seed=1"]]
    assert not plan.idle and plan.summary() == "" and plan.to_compose(jobs) == jobs
