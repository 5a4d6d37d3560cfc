"""Registration of the head template to a person: landmarks and surfaces in, a placed head out."""
