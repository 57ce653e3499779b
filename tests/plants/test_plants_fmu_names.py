"""Names of an FMU's variables in one text, as a command line gives them."""

from __future__ import annotations

import pytest

from harness import api
from harness.errors import InputError
from plants.fmu.variables import _listed
from plants.mockups import mockup


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("theta", ["theta"]),
        ("theta,omega", ["theta", "omega"]),
        ("[theta, omega]", ["theta", "omega"]),
        ("'theta', 'omega'", ["theta", "omega"]),
    ],
)
def test_several_names_in_one_text(text: str, names: list[str]) -> None:
    for given in (text, [text]):
        record = api.simulate(str(mockup("pendulum")), stop=0.1, step=0.05, options={"outputs": given})
        assert [channel.name for channel in record.spec.outputs] == names


def test_a_name_with_commas_is_one_name() -> None:
    assert _listed("a[1,2]", {"a[1,2]"}) == ["a[1,2]"]
    assert _listed("a[1,2],b", {"b"}) == ["a[1,2]", "b"]
    assert _listed("a,", set()) == ["a,"]
    with pytest.raises(InputError, match=r"got 'omga'; remedy: did you mean"):
        api.simulate(str(mockup("pendulum")), stop=0.1, step=0.05, options={"outputs": "theta,omga"})
