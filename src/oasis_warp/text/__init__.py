"""Words to an avatar: conditioning of a posed hand, a generator of the user's, and the check of its picture."""

from oasis_warp.text.conditioning import Conditioning as Conditioning
from oasis_warp.text.conditioning import make_conditioning as make_conditioning
from oasis_warp.text.generators import Generator as Generator
from oasis_warp.text.generators import choose_generator as choose_generator
from oasis_warp.text.generators import imagine as imagine
