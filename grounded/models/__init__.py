"""Systems that come with grounded, by the same door as the user's own: a module with a `model`.

Read `pendulum` first (the smallest), then `car` (section 5.2), then `aircraft` (section 5.1) with
`aircraft_trim`, its steady straight flight and turns. `buggy` and `lift` have kinks, `arm` and
`cart_pole` are mechanisms whose double stands in MuJoCo: systems of the blind challenge.
"""
