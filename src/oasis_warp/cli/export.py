"""`oasis export`: an avatar in a format of others."""

from oasis_warp.cli.options import Export
from oasis_warp.cli.record import written
from oasis_warp.cli.render import choose_pose
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.export.formats import choose_writer, export_avatar
from oasis_warp.export.page_file import write_page
from oasis_warp.hand_avatar import Avatar


def run(options: Export) -> int:
    """Write the file.

    Raises:
        InputError: a wrong avatar file, ending or output.
    """
    writer = choose_writer(options.out)  # refuse a wrong ending before the avatar is read
    photo = None if options.photo is None else read_photo(options.photo)
    if photo is not None and writer is not write_page:
        raise InputError(f"{options.out}: cannot hold --photo; choose a name that ends in .html, or leave it out.")
    avatar = Avatar.load(options.avatar)
    pose = None if options.pose == "auto" else choose_pose(avatar, options.pose)
    light = None if options.light == "auto" else options.light
    export_avatar(avatar, options.out, pose=pose, light=light, photo=photo)
    written(options.out)
    return 0
