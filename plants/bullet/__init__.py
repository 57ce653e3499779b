"""Arms in PyBullet: URDFs by path, robots that PyBullet ships.

``arm`` has the plant, ``world`` the client and its settings; add a robot in ``robots``.
"""

NEEDS = ("pybullet",)
