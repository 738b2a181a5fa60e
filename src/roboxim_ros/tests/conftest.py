from roboxim_ros.testing import graph_host

__all__ = ["graph_host"]
