const int vertex_blocks = (n_on_vertices + BLOCK - 1) / BLOCK;
const int blocks = vertex_blocks + (n_on_faces + BLOCK - 1) / BLOCK;
const int pose = block_index / blocks, mine = block_index - pose * blocks;
const bool on_vertex = mine < vertex_blocks;
const int i = (on_vertex ? mine : mine - vertex_blocks) * BLOCK + threadIdx.x;
if (i >= (on_vertex ? n_on_vertices : n_on_faces)) return;
const long long gaussian = on_vertex ? i : (long long)n_on_vertices + i;  // among those of a pose
const long long at = pose * ((long long)n_on_vertices + n_on_faces) + gaussian;
const long long first_vertex = (long long)pose * n_vertices;
#include "on_mesh.h"
