"""`oasis export`: an avatar in a format of others."""

from oasis_warp.cli.options import Export
from oasis_warp.cli.record import written
from oasis_warp.cli.render import choose_pose
from oasis_warp.export.formats import choose_writer, export_avatar
from oasis_warp.hand_avatar import Avatar


def run(options: Export) -> int:
    """Write the file.

    Raises:
        InputError: a wrong avatar file, ending or output.
    """
    choose_writer(options.out)  # refuse a wrong ending before the avatar is read
    avatar = Avatar.load(options.avatar)
    pose = None if options.pose == "auto" else choose_pose(avatar, options.pose)
    export_avatar(avatar, options.out, pose=pose, light=None if options.light == "auto" else options.light)
    written(options.out)
    return 0
