"""The published tables: printed figures as data, where the data sets come from, and ours beside the papers'."""

from heatsplat.studies.published.comparison import write_comparison as write_comparison
from heatsplat.studies.published.figures import METRICS as METRICS
from heatsplat.studies.published.figures import TITLES as TITLES
from heatsplat.studies.published.figures import Figure as Figure
from heatsplat.studies.published.figures import figures as figures
from heatsplat.studies.published.figures import quoted as quoted
from heatsplat.studies.published.figures import tables as tables
from heatsplat.studies.published.reproduction import Reproduction as Reproduction
from heatsplat.studies.published.reproduction import Run as Run
from heatsplat.studies.published.reproduction import reproduction_of as reproduction_of
from heatsplat.studies.published.sources import Source as Source
from heatsplat.studies.published.sources import source as source
