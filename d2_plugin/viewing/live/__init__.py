"""The page in the browser.

from d2_plugin.viewing.live import Viewer

viewer = Viewer(d2)              # after D2Hooks, in any trainer
"""

from d2_plugin.viewing.live.viewer import Viewer

__all__ = ["Viewer"]
