"""partialbench: pose-labelled single-view partial point clouds, and a benchmark on them.

The data flow one way, and the packages are named after its stages::

    source → occluder → sample → shard → loader → model → prediction → metrics → result → table

Importing this package is light: neither torch nor Mitsuba nor Open3D is loaded.
"""

__version__ = "0.1.0"
