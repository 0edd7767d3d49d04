"""Avatars in the formats of others: splat viewers, browsers, game engines, Blender, USD.

`formats` chooses a writer by the ending of the file's name. `splats` and `surface_mesh` make what files hold, and one
module a format writes it.
"""

from oasis_warp.export.formats import export_avatar as export_avatar
