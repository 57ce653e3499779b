"""Edges of couplings and of systems of other tools: what is taken, and what is refused by a hair."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.cosim import Coupled
from harness.cosim.structure import opened
from harness.cosim.structure.package import InFmu
from harness.errors import InputError, PlantError


def osp_with_groups(folder: Path, groups: str) -> Path:
    """Write an OSP structure that connects the group ``g`` of one box with that of another."""
    with zipfile.ZipFile(folder / "box.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", '<fmiModelDescription fmiVersion="2.0" modelName="Box" guid="g"/>')
    (folder / "Box_OspModelDescription.xml").write_text(
        f"<OspModelDescription><VariableGroups>{groups}</VariableGroups></OspModelDescription>"
    )
    boxes = "".join(f'<Simulator name="{name}" source="box.fmu"/>' for name in "ab")
    ends = "".join(f'<VariableGroup simulator="{name}" name="g"/>' for name in "ab")
    (folder / "OspSystemStructure.xml").write_text(
        f"<OspSystemStructure><Simulators>{boxes}</Simulators><Connections><VariableGroupConnection>{ends}"
        "</VariableGroupConnection></Connections></OspSystemStructure>"
    )
    return folder


@pytest.mark.parametrize(
    "groups",
    ['<Force name="g"><Variable/></Force>', '<Force><Variable ref="u"/></Force>',
     '<Generic name="g"><Force><Variable ref="u"/></Force></Generic>'],
)  # fmt: skip
def test_a_group_without_a_name_or_with_a_variable_without_one_is_refused(groups: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a name, and variables with a ref"), opened(osp_with_groups(tmp_path, groups)):
        pass
    with opened(osp_with_groups(tmp_path, '<Force name="g"><Variable ref="u"/></Force>')) as found:
        (wire,) = found.description.system.wires
    assert (wire.start, wire.end) == (("a", "u"), ("b", "u"))


def test_a_file_inside_an_fmu_may_be_as_large_as_is_said_and_no_larger(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "box.fmu", "w") as archive:
        archive.writestr("resources/a b.ssv", "12345678")
    inside = InFmu(tmp_path / "box.fmu", tmp_path / "s.ssd")
    assert inside.read("resources/a%20b.ssv", largest=8) == b"12345678"
    for name, largest in (("resources/a%20b.ssv", 7), ("resources/b.ssv", 8), ("file:resources/a%20b.ssv", 8)):
        with pytest.raises(InputError, match="a file inside an FMU"):
            inside.read(name, largest=largest)


def test_inputs_of_a_coupling_are_as_many_finite_numbers_as_it_has() -> None:
    arm = registry.create("plants", "pendulum-ode", sample_time=0.1)
    with Coupled({"arm": arm}, [], inputs=["arm.u"], outputs=["arm.theta"]) as one:
        first = one.reset(rng=np.random.default_rng(0))
        wrong: list[Any] = [np.ones(2), np.ones((1, 1)), np.array([np.nan]), np.array([np.inf]), [1.0, 2.0], 1.0, []]
        for u in wrong:
            with pytest.raises(InputError, match=r"1 finite numbers, shape \(1,\)"):
                one.step(u)
        assert np.array_equal(one.output(np.zeros(1)) if "feedthrough" in one.abilities else first, first)
        listed: Any = [0.5]
        moved = one.step(listed)
        one.reset(rng=np.random.default_rng(0))
        assert np.array_equal(one.step(np.array([0.5])), moved)


def test_what_breaks_in_a_part_bears_its_name_and_keeps_its_status() -> None:
    arm: Any = registry.create("plants", "pendulum-ode", sample_time=0.1)

    class Breaking:
        """The arm, but that nothing works that one of these methods does."""

        def __init__(self, method: str) -> None:
            self.method = method

        def __getattr__(self, name: str) -> Any:
            if name != self.method:
                return getattr(arm, name)

            def fail(*_: Any, **__: Any) -> Any:
                raise PlantError("out of wire", status="terminated")

            return fail

    orders: dict[str, Any] = {"reset": lambda one: one.reset(rng=np.random.default_rng(0)),
                              "step": lambda one: one.step(np.zeros(1)), "truth": lambda one: one.truth()}  # fmt: skip
    for method, order in orders.items():
        parts: Any = {"left arm": Breaking(method)}
        one = Coupled(parts, [], inputs=["left arm.u"], outputs=["left arm.theta"])
        with pytest.raises(PlantError, match=r"^part 'left arm': out of wire$") as caught:
            order(one)
        assert caught.value.status == "terminated"
