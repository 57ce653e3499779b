"""The spec of a model as a JSON-ready dictionary, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import Channel, PlantSpec


def channel_to_dict(one: Channel) -> dict[str, Any]:
    """Return a JSON-ready description of a channel; infinite limits become null."""
    content = asdict(one)
    for name in ("minimum", "maximum"):
        if not np.isfinite(content[name]):
            content[name] = None
    return content


def channel_from_dict(content: Mapping[str, Any]) -> Channel:
    """Return the channel of a description."""
    fields = dict(content)
    fields["minimum"] = -np.inf if fields.get("minimum") is None else float(fields["minimum"])
    fields["maximum"] = np.inf if fields.get("maximum") is None else float(fields["maximum"])
    return Channel(**fields)


def spec_to_dict(spec: PlantSpec) -> dict[str, Any]:
    """Return a JSON-ready description; infinite limits become null.

    Examples
    --------
    >>> spec = PlantSpec((), (Channel("y", "V"),), 0.1)
    >>> spec_from_dict(spec_to_dict(spec)) == spec
    True
    """
    return {
        "inputs": [channel_to_dict(one) for one in spec.inputs],
        "outputs": [channel_to_dict(one) for one in spec.outputs],
        "sample_time": spec.sample_time,
        "feedthrough": spec.feedthrough,
    }


def spec_from_dict(content: dict[str, Any]) -> PlantSpec:
    """Return the spec of a description.

    Raises
    ------
    InputError
        If a key is missing or of the wrong type.
    """
    try:
        return PlantSpec(
            tuple(channel_from_dict(one) for one in content["inputs"]),
            tuple(channel_from_dict(one) for one in content["outputs"]),
            float(content["sample_time"]),
            feedthrough=bool(content.get("feedthrough", False)),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            "description of a model's signals",
            expected="inputs, outputs, sample_time as written by to_dict()",
            got=f"{type(error).__name__}: {error}",
            remedy="fit it again: other versions wrote other files",
        ) from error
