"""Recorded data in and out: dataset.toml, bare CSV and Parquet files, MAT, HDF5, MDF4, MCAP and numpy files."""

from __future__ import annotations

from harness.data.recipe.description import parse_description, read_description
from harness.data.recipe.load import DATA_FOLDER, load_dataset
from harness.data.recipe.loaded import LoadedDataset, Nominal
from harness.data.recipe.si import si_unit
from harness.data.sections import NominalParameter, SourceSection
from harness.data.tables.columns import columns_of
from harness.data.trajectories import read_trajectory, write_trajectory
from harness.data.views import from_control, from_fmpy, to_pandas, to_polars, to_xarray

__all__ = [
    "DATA_FOLDER",
    "LoadedDataset",
    "Nominal",
    "NominalParameter",
    "SourceSection",
    "columns_of",
    "from_control",
    "from_fmpy",
    "load_dataset",
    "parse_description",
    "read_description",
    "read_trajectory",
    "si_unit",
    "to_pandas",
    "to_polars",
    "to_xarray",
    "write_trajectory",
]
