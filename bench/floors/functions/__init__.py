"""The floors of functions: each is deployed alone, with the standard library and what AWS' runtime has."""
