"""What the operators promise, measured on the machine and device they run on: `oasis gradcheck`.

`families` names the operators and what each is compared with, `checks` measures, `grid` spreads seeded scenes over
processes. Imports `ops` and `core` only; the float64 twins in `twins` share no code with the kernels.
"""
