"""Recorded data in and out: dataset.toml, bare CSV and Parquet files, MAT, HDF5, MDF4, MCAP and numpy files.

Names are loaded when they are asked for: who writes a file needs no reader.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
    from harness.data.recipe.description import parse_description, read_description
    from harness.data.recipe.load import load_dataset
    from harness.data.recipe.loaded import LoadedDataset, Nominal
    from harness.data.recipe.reading import DATA_FOLDER
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

_HOMES = {
    "DATA_FOLDER": "recipe.reading",
    "LoadedDataset": "recipe.loaded",
    "Nominal": "recipe.loaded",
    "NominalParameter": "sections",
    "SourceSection": "sections",
    "columns_of": "tables.columns",
    "from_control": "views",
    "from_fmpy": "views",
    "load_dataset": "recipe.load",
    "parse_description": "recipe.description",
    "read_description": "recipe.description",
    "read_trajectory": "trajectories",
    "si_unit": "recipe.si",
    "to_pandas": "views",
    "to_polars": "views",
    "to_xarray": "views",
    "write_trajectory": "trajectories",
}

__getattr__ = on_demand(__name__, _HOMES)
