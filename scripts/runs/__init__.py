"""Many runs of a script: side by side or one set after the other, and what they say together."""
