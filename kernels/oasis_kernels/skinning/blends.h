// The transforms, one a row of `columns`.

T* columns = (T*)malloc((n_joints + 16) * 16 * sizeof(T));  // one transform a row; on to a whole number of 16 rows
memset(columns, 0, (n_joints + 16) * 16 * sizeof(T));
for (int j = 0; j < n_joints; j++)
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 4; c++) columns[16 * j + 4 * c + r] = transforms[12 * j + 4 * r + c];
