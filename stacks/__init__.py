"""The cloud: one stack a file here; what they are made of is in `parts`, who watches them in `monitoring`.

app.py builds the stacks and passes objects from one to the next. They import the contract alone.
"""
