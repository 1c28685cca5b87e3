"""`make up`, `make down`, `make up-service`: the embedded cloud as a service that is kept, and its pages."""
