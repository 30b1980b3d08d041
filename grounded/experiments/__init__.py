"""The paper's studies, which `grounded experiment NAME` runs, and the systems of the demos.

A study is a module with a `run` that makes a list of independent, seeded jobs (read `jobs` first)
and a result with `to_json` and `tables`:

    flight           Table 1, Figure 1: an aircraft's figure-8 (task: `figure8`)
    car              Figures 4 and 5: three manoeuvres of the RC car (`car_tasks`, `real_car`)
    estimated        the same on estimated states; fit_car: its parameters from driving (`driving`)
    nondeterminism   repeated runs; repeats: the line search under noise
    baselines        seven methods (`ilc` is one) on one `bench`
    theorem1, footnote9     the paper's theoretical results
    pendulum         the smallest example, for `grounded demo`

Read `footnote9` first (the smallest), then `car`.
"""
