// A client of `closedloop serve SCENARIO`, in one file for C++17 and POSIX sockets. The messages: docs/serve.md.
//
//     closedloop::Client arm("127.0.0.1", 40000);
//     for (auto s = arm.reset(); s.done() == 0.0;) s = arm.torque(controller(s.q(), s.v()));
//
// A state is valid until the next message. Errors are std::runtime_error.
#pragma once

#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

namespace closedloop {

static_assert(sizeof(double) == 8, "messages have doubles of 8 bytes, little-endian");

// A view of the numbers of a state, for n joints, none of which turns freely.
struct State {
  const double* x;
  std::size_t n;
  double time() const { return x[0]; }
  double row() const { return x[1]; }
  double done() const { return x[2]; }
  double mode() const { return x[3]; }  // 0 free, 1 pressed, 2 stuck
  double contact_force() const { return x[4]; }
  double measured_force() const { return x[5]; }
  double closure_error() const { return x[6]; }
  double closure_rate() const { return x[7]; }
  const double* position() const { return x + 8; }
  const double* velocity() const { return x + 11; }
  const double* normal() const { return x + 14; }
  const double* friction_force() const { return x + 17; }
  const double* q() const { return x + 20; }
  const double* v() const { return x + 20 + n; }
  const double* acceleration() const { return x + 20 + 2 * n; }
  const double* torque() const { return x + 20 + 3 * n; }
};

class Client {
 public:
  Client(const std::string& address, std::uint16_t port) {
    socket_ = ::socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_port = htons(port);
    if (socket_ < 0 || ::inet_pton(AF_INET, address.c_str(), &to.sin_addr) != 1 ||
        ::connect(socket_, reinterpret_cast<sockaddr*>(&to), sizeof to) != 0) {
      if (socket_ >= 0) ::close(socket_);
      throw std::runtime_error("closedloop: cannot connect to " + address + ":" + std::to_string(port));
    }
    int on = 1;
    ::setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    send("CLB1", 4);
  }
  ~Client() { ::close(socket_); }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  // The description, JSON: joints, period, and the places of a state.
  std::string describe() { return text(0); }
  State reset() { return state(1); }
  State state() { return state(2); }
  // One step with a torque, N m, one number for each joint.
  State torque(const double* values, std::size_t n) { return state(3, values, n); }
  State torque(const std::vector<double>& values) { return torque(values.data(), values.size()); }
  // One step with the scenario's own law.
  State step() { return state(4); }
  // Force on the tip and its moment about the base's origin, six numbers, base axes.
  const double* wrench() {
    ask(5, nullptr, 0);
    return numbers_.data();
  }
  // What has happened to the contact since this was asked last, JSON.
  std::string events() { return text(6); }

 private:
  State state(std::uint32_t kind, const double* values = nullptr, std::size_t n = 0) {
    ask(kind, values, n);
    return State{numbers_.data(), (numbers_.size() - 20) / 4};
  }
  std::string text(std::uint32_t kind) {
    ask(kind, nullptr, 0);
    return text_;
  }
  void ask(std::uint32_t kind, const double* values, std::size_t n) {
    std::vector<char> message(8 + 8 * n);
    const std::uint32_t head[2] = {kind, static_cast<std::uint32_t>(8 * n)};
    std::memcpy(message.data(), head, 8);
    if (n > 0) std::memcpy(message.data() + 8, values, 8 * n);
    send(message.data(), message.size());
    std::uint32_t answer[2];
    receive(answer, 8);
    if (answer[0] == 0) {
      numbers_.resize(answer[1] / 8);
      receive(numbers_.data(), answer[1]);
      return;
    }
    text_.resize(answer[1]);
    receive(&text_[0], answer[1]);
    if (answer[0] != 1) throw std::runtime_error("closedloop: " + text_);
  }
  void send(const void* data, std::size_t size) {
    for (auto* at = static_cast<const char*>(data); size > 0;) {
      const ssize_t sent = ::send(socket_, at, size, MSG_NOSIGNAL);
      if (sent <= 0) throw std::runtime_error("closedloop: the server has closed the connection");
      at += sent;
      size -= static_cast<std::size_t>(sent);
    }
  }
  void receive(void* data, std::size_t size) {
    for (auto* at = static_cast<char*>(data); size > 0;) {
      const ssize_t got = ::recv(socket_, at, size, 0);
      if (got <= 0) throw std::runtime_error("closedloop: the server has closed the connection");
      at += got;
      size -= static_cast<std::size_t>(got);
    }
  }

  int socket_ = -1;
  std::vector<double> numbers_;
  std::string text_;
};

}  // namespace closedloop
