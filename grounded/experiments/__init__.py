"""The paper's studies, which `grounded experiment NAME` runs, and the systems of the demos.

A study is a module with a `run` that makes a list of independent, seeded jobs (read `jobs` first)
and a result with `to_json` and `tables`:

    flight           Table 1: an aircraft's figure-8 (task: `figure8`)
    car              Figures 4 and 5: three manoeuvres of the RC car (`car_tasks`, `real_car`)
    theory           the paper's theoretical results
    pendulum         the smallest example, for `grounded demo`

Read `footnote9` in `theory` first (the smallest), then `car`.
"""
