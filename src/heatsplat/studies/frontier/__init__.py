"""What accuracy costs in time: quality against seconds of finished runs."""

from heatsplat.studies.frontier.study import run as run
