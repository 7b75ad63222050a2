"""The paper: one equation, one place; pure functions of arrays and a model.

`chains` (assumption 4), `sliding` (section IV), `layer` and `tube` (eq. phidot,
Theorem 1), `tightening` (corollaries 1 and 2, Theorem 2), `stopping` and `stability`
beside them.  No scenario,
no plan and no optimisation may enter here.
"""
