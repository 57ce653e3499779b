"""A lever on a hinge, as a robot description."""

LEVER = """<robot name="lever">
  <link name="base"/>
  <link name="lever"><inertial><origin xyz="0 0 -0.3"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="lever"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
</robot>
"""
