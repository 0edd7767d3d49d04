"""What the operators promise, measured on the machine and device that they run on: `oasis gradcheck`.

`families` names the operators and their references, `compare` and `checks` measure, `certification` lists what to do.
"""
