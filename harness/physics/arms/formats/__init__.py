"""Robot descriptions read and written: URDF and MJCF.

May import the arms' own ``inertia``, ``joints`` and ``kinematics``.
"""
