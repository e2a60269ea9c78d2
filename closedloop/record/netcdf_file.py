"""NetCDF-4 by h5py alone: what h5netcdf writes, in a fifth of the time (it looks each dimension up in the file anew).

A dimension is an HDF5 dimension scale: the variable of its name, or a dataset that says that it is none. Each scale has
its number in `_Netcdf4Dimid`, and each variable those of its dimensions in `_Netcdf4Coordinates`; links and attributes
are kept in the order in which they were made. A dimension of length 0 has no fixed length: NetCDF knows no empty one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.record.unfailing import Unfailing

# The name of a scale without a variable, before its length in ten places: the one that the NetCDF library looks for.
NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."


class Variable(NamedTuple):
    """What is written of a variable."""

    dims: tuple[str, ...]  # the names of its dimensions
    data: NDArray[Any]  # numbers, or text as an array of objects
    attributes: Mapping[str, str] = {}  # texts by name


def write_netcdf(
    output: BinaryIO, dimensions: Mapping[str, int], variables: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> None:
    """Write a NetCDF-4 file, one variable after the other: beside them no more than the largest is in memory.

    Parameters
    ----------
    output : binary file
        Open, empty, to be read, written and sought in.
    dimensions : mapping
        Lengths by name.
    variables : mapping
        By name; one with the name of a dimension has that dimension alone.
    attributes : mapping
        The file's own attributes.
    """
    import h5py

    image = Unfailing(output)
    numbers = {name: np.int32(number) for number, name in enumerate(dimensions)}
    with h5py.File(image, "w", track_order=True) as file:
        made_by = f"version=2,hdf5={h5py.version.hdf5_version},h5py={h5py.__version__}"
        file.attrs["_NCProperties"] = np.bytes_(made_by)
        scales: dict[str, Any] = {}

        def create(name: str, dims: tuple[str, ...], **content: Any) -> Any:
            limits = tuple(dimensions[dim] or None for dim in dims)
            more = {"maxshape": limits} if None in limits else {}
            dataset = file.create_dataset(
                name, tuple(dimensions[dim] for dim in dims), track_order=True, **content, **more
            )
            if name in dimensions:
                dataset.attrs["_Netcdf4Dimid"] = numbers[name]
                dataset.make_scale(name if name in variables else f"{NO_VARIABLE}{dimensions[name]:10}")
                scales[name] = dataset
            return dataset

        # All scales before the first variable that refers to them.
        order = [
            *(name for name in dimensions if name not in variables),
            *(name for name in dimensions if name in variables),
        ]
        for name in [*order, *(name for name in variables if name not in dimensions)]:
            if name not in variables:
                create(name, (name,), dtype=">f4")
                continue
            dims, data, texts = variables[name]
            kind = h5py.string_dtype() if data.dtype == object else data.dtype
            dataset = create(name, dims, dtype=kind, data=data)
            image.check()
            if name not in dimensions:
                for axis, dim in enumerate(dims):
                    dataset.dims[axis].attach_scale(scales[dim])
                if dimensions[dims[0]]:
                    dataset.attrs["_Netcdf4Dimid"] = numbers[dims[0]]
            dataset.attrs["_Netcdf4Coordinates"] = np.array([numbers[dim] for dim in dims])
            for key, text in texts.items():
                dataset.attrs[key] = text
        for key, value in attributes.items():
            file.attrs[key] = value if isinstance(value, str) else np.atleast_1d(value)
    image.check()
