"""Models that come with grounded: each is a module with a `model`, like a user's model.py.

Read `pendulum` first (the smallest), then `car` (section 5.2), then `aircraft` (section 5.1) with
`aircraft_trim`, its trim in steady straight flight and turns. `buggy` and `lift` have kinks, `arm`
and `cart_pole` also exist as MuJoCo models; all four are systems of the blind challenge.
"""
