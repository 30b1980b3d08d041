"""What is taken home: the model with the values found, in the form that it came in.

Read `export_model` in `taking_home` first. `xml_text` keeps comments, order and layout of a
file; `held` says which effect is which number of a joint or an actuator; `mjcf` writes these
numbers into MJCF and URDF files.
"""
