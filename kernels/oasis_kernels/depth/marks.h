// Marks of a vertex: nothing is known of the place on the screen of one that is BEHIND the near plane; ODD ones are
// out of reach of fixed point; a LOST one has no finite place. The others tell on which side of the picture it is.
constexpr int BEHIND = 1, ODD = 2, LOST = 4, LEFT = 8, RIGHT = 16, ABOVE = 32, BELOW = 64;
