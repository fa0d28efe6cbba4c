// AgIsoStack++ as a node on our bus: a control function over an slcan adapter. `peer PORT ADDRESS`
//
// Commands come by standard input, one a line; what it sees leaves by standard output, one JSON object a line. All that
// J1939 asks of a node (claims, requests, transport sessions) is the library's; only the adapter's lines are ours.

#include "isobus/hardware_integration/can_hardware_interface.hpp"
#include "isobus/hardware_integration/can_hardware_plugin.hpp"
#include "isobus/isobus/can_network_manager.hpp"
#include "isobus/isobus/can_parameter_group_number_request_protocol.hpp"

#include <fcntl.h>
#include <poll.h>
#include <termios.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <vector>

namespace
{
	constexpr std::uint8_t LAND_LEVELING_SUPERVISOR = 132; // NAME function of graderd
	constexpr std::uint32_t PROPRIETARY_A = 0xEF00, DM1 = 0xFECA;
	constexpr std::uint32_t COMPONENT_ID = 0xFEEB, SOFTWARE_ID = 0xFEDA, ACKNOWLEDGEMENT = 0xE800;

	std::mutex saying;

	void say(const std::string &json)
	{
		const std::lock_guard<std::mutex> lock(saying);
		std::cout << json << std::endl;
	}

	std::string hex(const std::vector<std::uint8_t> &data)
	{
		std::string text;
		char two[3];
		for (const auto byte : data)
		{
			std::snprintf(two, sizeof two, "%02X", byte);
			text += two;
		}
		return text;
	}

	/// An slcan (Lawicel) adapter at 250 kbit/s.
	class Slcan : public isobus::CANHardwarePlugin
	{
	public:
		explicit Slcan(std::string port) : port(std::move(port)) {}

		std::string get_name() const override { return "slcan " + port; }
		bool get_is_valid() const override { return fd >= 0; }

		void open() override
		{
			fd = ::open(port.c_str(), O_RDWR | O_NOCTTY | O_NONBLOCK);
			if (fd < 0)
			{
				return;
			}
			termios raw{};
			tcgetattr(fd, &raw);
			cfmakeraw(&raw);
			tcsetattr(fd, TCSANOW, &raw);
			put("C\rS5\rO\r");
		}

		void close() override
		{
			if (fd >= 0)
			{
				put("C\r");
				::close(fd);
				fd = -1;
			}
		}

		bool read_frame(isobus::CANMessageFrame &frame) override
		{
			for (;;)
			{
				const auto end = waiting.find_first_of("\r\a");
				if (end == std::string::npos)
				{
					pollfd ready{ fd, POLLIN, 0 };
					char bytes[512];
					const auto n = poll(&ready, 1, 50) > 0 ? ::read(fd, bytes, sizeof bytes) : 0;
					if (n <= 0)
					{
						return false;
					}
					waiting.append(bytes, static_cast<std::size_t>(n));
					continue;
				}
				const auto line = waiting.substr(0, end);
				waiting.erase(0, end + 1);
				if (line.size() >= 10 && line[0] == 'T')
				{
					return parse(line, frame);
				}
			}
		}

		bool write_frame(const isobus::CANMessageFrame &frame) override
		{
			char head[16];
			std::snprintf(head, sizeof head, "T%08X%u", frame.identifier, frame.dataLength);
			return put(head + hex({ frame.data, frame.data + frame.dataLength }) + "\r");
		}

	private:
		static bool parse(const std::string &line, isobus::CANMessageFrame &frame)
		{
			frame.identifier = static_cast<std::uint32_t>(std::stoul(line.substr(1, 8), nullptr, 16));
			frame.dataLength = static_cast<std::uint8_t>(line[9] - '0');
			frame.isExtendedFrame = true;
			frame.channel = 0;
			for (std::size_t i = 0; i < frame.dataLength; i++)
			{
				frame.data[i] = static_cast<std::uint8_t>(std::stoul(line.substr(10 + 2 * i, 2), nullptr, 16));
			}
			return true;
		}

		bool put(const std::string &line) const
		{
			return ::write(fd, line.data(), line.size()) == static_cast<ssize_t>(line.size());
		}

		const std::string port;
		int fd = -1;
		std::string waiting;
	};

	void on_message(const isobus::CANMessage &message, void *)
	{
		std::ostringstream json;
		json << R"({"event": "message", "pgn": )" << message.get_identifier().get_parameter_group_number()
		     << R"(, "from": )" << static_cast<int>(message.get_identifier().get_source_address())
		     << R"(, "data": ")" << hex(message.get_data()) << R"("})";
		say(json.str());
	}

	/// Control messages of the actuators are not ours to receive; they are on the wire all the same. So are claims.
	void on_frame(const isobus::CANMessageFrame &frame)
	{
		if (((frame.identifier >> 16) & 0x1FF) == 0xEE)
		{
			say(R"({"event": "claim", "from": )" + std::to_string(frame.identifier & 0xFF) + R"(, "name": ")" +
			    hex({ frame.data, frame.data + frame.dataLength }) + R"("})");
		}
		if (((frame.identifier >> 16) & 0x1FF) == 0xEF && frame.dataLength == 8)
		{
			std::ostringstream json;
			json << R"({"event": "control", "from": )" << (frame.identifier & 0xFF) << R"(, "to": )"
			     << ((frame.identifier >> 8) & 0xFF) << R"(, "enable": )" << ((frame.data[3] >> 4) & 1) << "}";
			say(json.str());
		}
	}

	isobus::NAME name_of(std::uint32_t identity, std::uint8_t function)
	{
		isobus::NAME name(0);
		name.set_arbitrary_address_capable(true);
		name.set_industry_group(3);
		name.set_function_code(function);
		name.set_identity_number(identity);
		name.set_manufacturer_code(0);
		return name;
	}
}

int main(int argc, char **argv)
{
	if (argc != 3)
	{
		std::cerr << "peer PORT ADDRESS" << std::endl;
		return 2;
	}
	using isobus::CANHardwareInterface;
	auto &network = isobus::CANNetworkManager::CANNetwork;
	const auto adapter = std::make_shared<Slcan>(argv[1]);
	CANHardwareInterface::set_number_of_can_channels(1);
	CANHardwareInterface::assign_can_channel_frame_handler(0, adapter);
	CANHardwareInterface::get_can_frame_received_event_dispatcher().add_listener(on_frame);
	if (!CANHardwareInterface::start() || !adapter->get_is_valid())
	{
		std::cerr << argv[1] << ": cannot be opened" << std::endl;
		return 1;
	}
	// A function of another number than graderd's, with a NAME that comes after it; claims as the library does.
	auto own = network.create_internal_control_function(name_of(77, 250), 0, static_cast<std::uint8_t>(std::stoi(argv[2])));
	const isobus::NAMEFilter filter(isobus::NAME::NAMEParameters::FunctionCode, LAND_LEVELING_SUPERVISOR);
	auto graderd = network.create_partnered_control_function(0, { filter });
	std::shared_ptr<isobus::InternalControlFunction> rival;
	for (const auto pgn : { COMPONENT_ID, SOFTWARE_ID, ACKNOWLEDGEMENT, PROPRIETARY_A, DM1 })
	{
		network.add_any_control_function_parameter_group_number_callback(pgn, on_message, nullptr);
	}

	std::atomic_bool running{ true };
	std::thread watch([&]() {
		int own_was = -1, graderd_was = -1;
		while (running)
		{
			const int own_is = own->get_address_valid() ? own->get_address() : -1;
			const int graderd_is = graderd->get_address_valid() ? graderd->get_address() : -1;
			if (own_is != own_was || graderd_is != graderd_was)
			{
				own_was = own_is;
				graderd_was = graderd_is;
				say(R"({"event": "addresses", "own": )" + std::to_string(own_is) + R"(, "graderd": )" + std::to_string(graderd_is) + "}");
			}
			std::this_thread::sleep_for(std::chrono::milliseconds(20));
		}
	});

	for (std::string line; std::getline(std::cin, line);)
	{
		std::istringstream words(line);
		std::string command;
		std::uint32_t number = 0;
		words >> command >> number;
		bool done = true;
		if (command == "request")
		{
			done = isobus::ParameterGroupNumberRequestProtocol::request_parameter_group_number(number, own, graderd);
		}
		else if (command == "send")
		{
			std::vector<std::uint8_t> data(number);
			for (std::size_t i = 0; i < data.size(); i++)
			{
				data[i] = static_cast<std::uint8_t>(i);
			}
			done = network.send_can_message(PROPRIETARY_A, data.data(), number, own, graderd);
		}
		else if (command == "rival")
		{
			// a NAME that goes before graderd's, and its address
			rival = network.create_internal_control_function(name_of(0, 1), 0, static_cast<std::uint8_t>(number));
		}
		else
		{
			done = false;
		}
		say(std::string(R"({"event": "done", "command": ")") + line + R"(", "ok": )" + (done ? "true" : "false") + "}");
	}
	running = false;
	watch.join();
	CANHardwareInterface::stop();
	return 0;
}
