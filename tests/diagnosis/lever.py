"""A lever on a hinge, as a robot description."""


def lever_urdf(mass: float = 1.0, inertia: float = 0.02) -> str:
    """Return a URDF of one link that hangs 0.3 m below its hinge."""
    return f"""<robot name="lever">
  <link name="base"/>
  <link name="lever"><inertial><origin xyz="0 0 -0.3"/><mass value="{mass}"/>
    <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="lever"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
</robot>
"""
