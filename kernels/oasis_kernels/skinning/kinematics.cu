// From joint angles to the transforms of bones, and back, on the CPU and on CUDA by one source.
//
// A bone turns about its joint J, in its parent's frame, by the product L of three rotations, about its axes of
// flexion, abduction and twist. As a transform of rest points that is A = (L | J - L J), and with P the bone's parent
//
//     T = T_P A,    T_0 = (orientation | translation).
//
// `transforms` (one pose a task, or a block, whose threads share the bones) keeps every A, in float64, for
// `transforms_backward`. There, with G the gradient by T, parents collect G_P += G A^T from the last bone to the first;
// then the gradient by A is R_P^T G, and a small angle about an axis spins L by that axis, as the rotations before it
// turn it.
//
// Pose correctives follow the flexion: two strengths a bone, c and c^2, c = 1 - cos(flexion). Arithmetic is float64
// whatever the arrays hold.

void bone_transforms(
#include "bone_parameters.inc"
    const T* orientation,  // [B, 3, 3]
    const T* translation,  // [B, 3]
    double* locals,        // [B, J, LOCAL]
    T* transforms,         // [B, J, 3, 4]
    T* bends               // [B, J - 1, 2]
) {
#include "bones.h"
#include "each_pose.h"
    double* local = locals + pose * LOCAL * n_joints;
    EACH_BONE {
        double* to = local + LOCAL * j;
        if (j == 0) {  // has no transform of its own
            for (int k = 0; k < LOCAL; k++) to[k] = 0.0;
            continue;
        }
        const T *a = angle + 3 * (j - 1), *axis = axes + 9 * j;
        const D33 bend = times(about(read3(axis), a[0]), about(read3(axis + 3), a[1]));
        const D33 turn = times(bend, about(read3(axis + 6), a[2]));
        const D3 joint = read3(joints + 3 * j), moved = apply(turn, joint);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) to[3 * r + c] = turn.m[r][c];
        to[9] = joint.x - moved.x;
        to[10] = joint.y - moved.y;
        to[11] = joint.z - moved.z;
        const double c = 1.0 - wp::cos((double)a[0]);
        T* bends_of_bone = bends + (pose * (n_joints - 1) + j - 1) * 2;
        bends_of_bone[0] = (T)c;
        bends_of_bone[1] = (T)(c * c);
    }
    TOGETHER
    EACH_BONE {
        D33 turn = {{{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
        D3 shift = {0.0, 0.0, 0.0};
        auto then = [&](const D33& by, D3 to) {
            const D3 moved = apply(by, shift);
            turn = times(by, turn);
            shift = {moved.x + to.x, moved.y + to.y, moved.z + to.z};
        };
        for (int p = j; p > 0; p = parents[p]) {
            const double* a = local + LOCAL * p;
            then({{{a[0], a[1], a[2]}, {a[3], a[4], a[5]}, {a[6], a[7], a[8]}}}, {a[9], a[10], a[11]});
        }
        const T *o = orientation + 9 * pose, *t = translation + 3 * pose;
        then(
            {{{(double)o[0], (double)o[1], (double)o[2]},
              {(double)o[3], (double)o[4], (double)o[5]},
              {(double)o[6], (double)o[7], (double)o[8]}}},
            read3(t)
        );
        const double shifts[3] = {shift.x, shift.y, shift.z};
        T* to = transforms + 12 * (pose * n_joints + j);
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++) to[4 * r + c] = (T)turn.m[r][c];
            to[4 * r + 3] = (T)shifts[r];
        }
    }
#if !defined(__CUDA_ARCH__)
});
#endif
}

void bone_transforms_backward(
#include "bone_parameters.inc"
    const T* transforms,    // [B, J, 3, 4]
    const double* locals,   // [B, J, LOCAL]
    const T* g_transforms,  // [B, J, 3, 4]; these two may be 0
    const T* g_bends,       // [B, J - 1, 2]
    double* sums,           // [B, J, 3, 4], scratch
    T* g_angles,            // [B, J - 1, 3]; each of these is 0 if not wanted
    T* g_orientation,       // [B, 3, 3]
    T* g_translation,       // [B, 3]
    T* g_joints             // [B, J, 3]
) {
#include "bones.h"
#include "each_pose.h"
    const double* local = locals + pose * LOCAL * n_joints;
    double* sum = sums + pose * 12 * n_joints;
    EACH_ROW {
        for (int j = 0; j < n_joints; j++)
            for (int c = 0; c < 4; c++)
                sum[12 * j + 4 * r + c] =
                    g_transforms ? (double)g_transforms[12 * (pose * n_joints + j) + 4 * r + c] : 0.0;
        for (int j = n_joints - 1; j > 0; j--) {
            const double *g = sum + 12 * j + 4 * r, *a = local + LOCAL * j;
            double* to = sum + 12 * parents[j] + 4 * r;
            for (int c = 0; c < 3; c++)
                to[c] += g[0] * a[3 * c] + g[1] * a[3 * c + 1] + g[2] * a[3 * c + 2] + g[3] * a[9 + c];
            to[3] += g[3];
        }
    }
    TOGETHER
    EACH_BONE {
        const double* g = sum + 12 * j;
        if (j == 0) {
            for (int r = 0; r < 3; r++) {
                if (g_orientation)
                    for (int c = 0; c < 3; c++) g_orientation[9 * pose + 3 * r + c] = (T)g[4 * r + c];
                if (g_translation) g_translation[3 * pose + r] = (T)g[4 * r + 3];
                if (g_joints) g_joints[3 * pose * n_joints + r] = (T)0;
            }
            continue;
        }
        const T* parent = transforms + 12 * (pose * n_joints + parents[j]);
        double by_turn[3][3], by_shift[3];
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++)
                by_turn[r][c] = parent[r] * g[c] + parent[4 + r] * g[4 + c] + parent[8 + r] * g[8 + c];
            by_shift[r] = parent[r] * g[3] + parent[4 + r] * g[7] + parent[8 + r] * g[11];
        }
        const double* l = local + LOCAL * j;
        if (g_joints)
            for (int c = 0; c < 3; c++)
                g_joints[3 * (pose * n_joints + j) + c] =
                    (T)(by_shift[c] - (l[c] * by_shift[0] + l[3 + c] * by_shift[1] + l[6 + c] * by_shift[2]));
        if (!g_angles) continue;
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) by_turn[r][c] -= by_shift[r] * joints[3 * j + c];
        auto entry = [&](int r, int c) -> double {  // of by_turn L^T
            return by_turn[r][0] * l[3 * c] + by_turn[r][1] * l[3 * c + 1] + by_turn[r][2] * l[3 * c + 2];
        };
        const D3 spin = {entry(2, 1) - entry(1, 2), entry(0, 2) - entry(2, 0), entry(1, 0) - entry(0, 1)};
        const T *a = angle + 3 * (j - 1), *axis = axes + 9 * j;
        const D33 flexion = about(read3(axis), a[0]);
        const D3 second = apply(flexion, read3(axis + 3));
        const D3 third = apply(times(flexion, about(read3(axis + 3), a[1])), read3(axis + 6));
        double by_flexion = dot(spin, read3(axis));
        if (g_bends) {
            const T* by = g_bends + (pose * (n_joints - 1) + j - 1) * 2;
            by_flexion += wp::sin((double)a[0]) * (by[0] + 2.0 * (1.0 - wp::cos((double)a[0])) * by[1]);
        }
        T* to = g_angles + 3 * (pose * (n_joints - 1) + j - 1);
        to[0] = (T)by_flexion;
        to[1] = (T)dot(spin, second);
        to[2] = (T)dot(spin, third);
    }
#if !defined(__CUDA_ARCH__)
});
#endif
}
