"""The preflight: finds beforehand, by reading only, what would make a deployment fail. It may use stacks/."""
