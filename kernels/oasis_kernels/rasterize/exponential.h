// e^x for -80 < x < 80, for scalars and for vectors: VECTOR of float, INTEGERS of int.

// e^x = 2^f 2^n with n the whole number nearest to x log2(e): adding 1.5 * 2^23 rounds, and leaves n in the low
// bits, from where it is added to the exponent. 2^f on |f| <= 0.5 is a minimax polynomial, relative error 2e-7.
auto exponential = [](VECTOR x) -> VECTOR {
    const VECTOR scaled = x * 1.44269504f;
    const VECTOR rounded = scaled + 12582912.f;
    const VECTOR f = scaled - (rounded - 12582912.f);
    VECTOR p = f * 0.001327647174f + 0.00967554154f;
    p = p * f + 0.05550713276f;
    p = p * f + 0.2402211972f;
    p = p * f + 0.6931469671f;
    p = p * f + 1.000000072f;
    return __builtin_bit_cast(VECTOR, __builtin_bit_cast(INTEGERS, p) + (__builtin_bit_cast(INTEGERS, rounded) << 23));
};
